"""Jobs: what the worker process is asked to do, and what it returns.

A job is plain data that travels to the worker; ``run`` is called there. It works in ``staging`` and
leaves the scene there, with its scratch files in ``staging/.work``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from splatseed.scene import Image
from splatseed.sfm.cameras import guess_cameras, known_cameras
from splatseed.sfm.export import export_scene
from splatseed.sfm.features import Run, find_features, match_features, write_database
from splatseed.sfm.photos import Photo
from splatseed.sfm.report import Refinement
from splatseed.sfm.settings import Settings
from splatseed.sfm.solving.mapping import map_images, triangulate_points
from splatseed.sfm.solving.refinement import refine
from splatseed.sfm.stages import Stages


@dataclass(frozen=True)
class Outcome:
    """The result of a job; see ``SfmReport`` for the fields."""

    registered: frozenset[str]
    num_points: int
    mean_track_length: float
    mean_reprojection_error: float
    seconds: Mapping[str, float]
    refinement: Refinement | None = None


@dataclass(frozen=True)
class ReconstructJob:
    """Poses, lenses and points from photographs.

    Args:
        image_dir: The photographs.
        staging: Where the scene is made.
        settings: The settings of the run.
        photos: Which photographs.
        camera_model: COLMAP's model of the lens.
        shared_camera: One lens for all photographs of a size, or one for each.
    """

    image_dir: Path
    staging: Path
    settings: Settings
    photos: tuple[Photo, ...]
    camera_model: str
    shared_camera: bool

    def run(self, stages: Stages) -> Outcome:
        """Do it, in this process."""
        run = Run(stages, self.settings, self.image_dir, self.staging / ".work")
        write_database(
            run, *guess_cameras(run, self.photos, self.camera_model, shared=self.shared_camera)
        )
        names = [photo.name for photo in self.photos]
        find_features(run, names)
        match_features(run)
        export_scene(run, map_images(run, self.photos, self.camera_model), self.staging)
        return _outcome(run, self.staging)


@dataclass(frozen=True)
class TriangulateJob:
    """Points from photographs with known poses.

    Args:
        image_dir: The photographs.
        staging: Where the scene is made.
        settings: The settings of the run.
        pairs: The photographs, each with its pose and intrinsics.
        refine_poses: Whether the poses are refined first.
    """

    image_dir: Path
    staging: Path
    settings: Settings
    pairs: tuple[tuple[Photo, Image], ...]
    refine_poses: bool

    def run(self, stages: Stages) -> Outcome:
        """Do it, in this process."""
        run = Run(stages, self.settings, self.image_dir, self.staging / ".work")
        cameras, images = known_cameras(run, self.pairs)
        write_database(run, cameras, images)
        find_features(run, [photo.name for photo, _ in self.pairs])
        match_features(run)
        poses, refinement = [image for _, image in self.pairs], None
        if self.refine_poses:
            poses, refinement = refine(run, cameras, images, poses)
        model_dir = triangulate_points(run, cameras, images, poses)
        export_scene(run, model_dir, self.staging)
        return replace(_outcome(run, self.staging), refinement=refinement)


@dataclass(frozen=True)
class UndistortJob:
    """A scene without distortion.

    Args:
        image_dir: The photographs.
        staging: Where the scene is made.
        settings: The settings of the run.
        model_dir: The COLMAP model.
    """

    image_dir: Path
    staging: Path
    settings: Settings
    model_dir: Path

    def run(self, stages: Stages) -> Outcome:
        """Do it, in this process."""
        run = Run(stages, self.settings, self.image_dir, self.staging / ".work")
        export_scene(run, self.model_dir, self.staging, distinct=False)
        return _outcome(run, self.staging)


Job: TypeAlias = ReconstructJob | TriangulateJob | UndistortJob


def _outcome(run: Run, scene: Path) -> Outcome:
    """The contents of the scene, read back from its files."""
    model = run.pycolmap.Reconstruction(scene / "sparse" / "0")
    return Outcome(
        registered=frozenset(image.name for image in model.images.values() if image.has_pose),
        num_points=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error=float(model.compute_mean_reprojection_error()),
        seconds=dict(run.stages.seconds),
    )
