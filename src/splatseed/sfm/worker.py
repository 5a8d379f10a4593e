"""The work of pycolmap, in a process of its own.

A failure deep in COLMAP (a full disk under SQLite, a broken image codec) aborts the process it
happens in, and only a kill stops some of its loops. So an abort becomes a ``ReconstructionError``,
and an interrupt a kill.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from splatseed.errors import ReconstructionError, TaskLostError
from splatseed.progress import Progress
from splatseed.runtime.tasks import Child
from splatseed.scene import Image
from splatseed.sfm.features import (
    Run,
    Settings,
    guess_cameras,
    known_cameras,
    match_photographs,
    require_pycolmap,
)
from splatseed.sfm.mapping import export_scene, map_images, triangulate_points
from splatseed.sfm.photos import Photo
from splatseed.sfm.refinement import Refinement, refine

_REASON = re.compile(r"what\(\):\s*(.*)|^[EF]\d{8}\s.*?\]\s*(.*)", re.MULTILINE)


@dataclass(frozen=True)
class SfmReport:
    """The outcome of ``reconstruct``, ``triangulate`` or ``undistort``.

    Args:
        path: The scene folder that was written.
        registered: Images with a pose in the scene.
        total: Images that were given.
        unregistered: Names of the images without a pose, sorted; they are not in the scene.
        num_points: Points in the scene.
        mean_track_length: Observations per point.
        mean_reprojection_error: Mean over points of their mean reprojection error, px of the
            scene's (undistorted) images.
        seconds: Wall time of each stage, in the order in which they ran.
        refinement: What refinement changed; None where it was not asked for.
    """

    path: Path
    registered: int
    total: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_track_length: float
    mean_reprojection_error: float
    seconds: Mapping[str, float]
    refinement: Refinement | None = None


Job: TypeAlias = Callable[..., SfmReport]
"""Takes a run, the folder to make the scene in, and arguments of its own."""


def reconstruct_job(
    run: Run, staging: Path, photos: Sequence[Photo], camera_model: str, shared_camera: bool
) -> SfmReport:
    """Poses, lenses and points from photographs."""
    match_photographs(run, *guess_cameras(run, photos, camera_model, shared=shared_camera))
    export_scene(run, map_images(run, photos, camera_model), staging)
    return _report(run, staging, [photo.name for photo in photos])


def triangulate_job(
    run: Run,
    staging: Path,
    photos: Sequence[Photo],
    pairs: Sequence[tuple[Photo, Image]],
    refine_poses: bool,
) -> SfmReport:
    """Points from photographs with known poses."""
    cameras, images = known_cameras(run, pairs)
    match_photographs(run, cameras, images)
    poses, refinement = [image for _, image in pairs], None
    if refine_poses:
        poses, refinement = refine(run, cameras, images, poses)
    export_scene(run, triangulate_points(run, cameras, images, poses), staging)
    return _report(run, staging, [photo.name for photo in photos], refinement)


def undistort_job(run: Run, staging: Path, model_dir: Path, names: Sequence[str]) -> SfmReport:
    """The scene of a COLMAP model without distortion."""
    export_scene(run, model_dir, staging, distinct=False)
    return _report(run, staging, names)


def _report(
    run: Run, staging: Path, names: Sequence[str], refinement: Refinement | None = None
) -> SfmReport:
    """The contents of the scene, read back from its files."""
    model = run.pycolmap.Reconstruction(staging / "sparse" / "0")
    registered = {image.name for image in model.images.values() if image.has_pose}
    return SfmReport(
        path=staging,
        registered=len(registered),
        total=len(names),
        unregistered=tuple(name for name in names if name not in registered),
        num_points=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error=float(model.compute_mean_reprojection_error()),
        seconds=dict(run.seconds),
        refinement=refinement,
    )


def run_job(
    job: Job,
    image_dir: Path,
    staging: Path,
    settings: Settings,
    *arguments: object,
    on_progress: Progress,
) -> SfmReport:
    """Do a job, with ``arguments`` of its own, in a child process.

    The scene is made in ``staging``; scratch files and the log go to ``.work`` in it.

    Raises:
        SplatseedError: The job failed; the error is the child's.
        ReconstructionError: The child died.
    """
    log = staging / ".work" / "log.txt"
    call = (_work, job, image_dir, staging, settings, arguments)
    with closing(Child(log=log.open("w+b"))) as child:
        try:
            report: SfmReport = child.call(*call, progress=on_progress)
        except TaskLostError as error:
            reasons = _REASON.findall(log.read_text("utf-8", "replace"))
            how = f"{error.found.partition(':')[0]}: {''.join(reasons[-1])}" if reasons else None
            raise ReconstructionError(
                "pycolmap to finish",
                found=how or error.found,
                fix="Check disk space and memory.",
            ) from error
    return report


def _work(
    job: Job,
    image_dir: Path,
    staging: Path,
    settings: Settings,
    arguments: tuple[object, ...],
    progress: Progress,
) -> SfmReport:
    """Do the job, in the child."""
    pycolmap = require_pycolmap(settings.device)
    pycolmap.logging.logtostderr = True  # alone: it would leave files in the temporary folder
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    return job(Run(pycolmap, settings, image_dir, staging / ".work", progress), staging, *arguments)
