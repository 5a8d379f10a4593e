"""A scene at refined poses, with the points that its photographs' features give."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory

from splatseed.errors import SceneNotFoundError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.sfm.pipeline import triangulate
from splatseed.sfm.report import SfmReport


def refined(scene: Scene, seed: int, progress: Progress = silent) -> tuple[Scene, str]:
    """The scene at refined poses, with the points that its photographs' features give.

    Its photographs, lenses and depth maps stay; its own points are replaced.

    Args:
        scene: A scene with photographs.
        seed: Seed of every random choice.
        progress: Called with the stage and the fraction done.

    Returns:
        The scene, and what was done in a sentence.

    Raises:
        SceneNotFoundError: It has no photographs.
        ReconstructionError: The poses drifted, or no point could be triangulated.
        MissingDependencyError: pycolmap is absent.
    """
    folder = scene.source.image_dir if scene.source else None
    if folder is None:
        raise SceneNotFoundError(
            "photographs, at whose features --refine-poses looks",
            found="no folder with images",
            fix="Put them beside the model in a folder named images, or leave it out.",
        )
    with TemporaryDirectory(prefix="splatseed-refine-") as name:
        report = triangulate(
            folder, scene, Path(name) / "scene", refine_poses=True, seed=seed, on_progress=progress
        )
        found = load_scene(report.path)
    return with_refined(scene, found), _told(report)


def with_refined(scene: Scene, found: Scene) -> Scene:
    """The scene with the poses and the points of another of the same photographs.

    Args:
        scene: Images that the other scene lacks keep their poses.
        found: Its points count as originals without tracks.
    """
    posed = {image.name: image for image in found.images}
    images = tuple(
        dataclasses.replace(
            image, quat=posed[image.name].quat, translation=posed[image.name].translation
        )
        if image.name in posed
        else image
        for image in scene.images
    )
    points = PointCloud(found.points.xyz, found.points.rgb)
    return scene.replace(images=images, points=points, tracks=None)


def _told(report: SfmReport) -> str:
    refinement, points = report.refinement, f"{report.num_points:,} points were triangulated"
    assert refinement is not None  # noqa: S101  (it was asked for)
    if refinement.kept:
        return f"Poses are as given: refined, they would gain less than 0.1 px. {points}."
    return (
        f"Refined poses lower the mean reprojection error from {refinement.error_before:.2f} to "
        f"{refinement.error_after:.2f} px: cameras turned by {refinement.median_turn:.2f} degrees "
        f"and moved by {refinement.median_shift:.3g} units, both the median; {points}."
    )
