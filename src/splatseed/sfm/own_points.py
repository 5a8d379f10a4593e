"""What becomes of the points of a scene when its poses are refined.

Structure-from-Motion's were triangulated at the given poses, so others take their place. Points
without tracks, such as those of LiDAR, were measured in a frame that refined poses keep: they stay,
if photographs do not contradict them there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from splatseed.checkup.choices import UnfitPoints
from splatseed.findings import Finding
from splatseed.io.colmap import read_points3d, write_points3d
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress
from splatseed.scene import Image, LeftOut, Scene

if TYPE_CHECKING:  # Numba, for which --help would wait, comes with it
    from splatseed.checkup.consistency import Fit

Color: TypeAlias = Callable[[Scene], Scene]
"""Gives colours to a scene's points where they lack them."""
_MOVED = "transformed-points"
_LESS = 0.05
"""Smallest fall of the share of points that photographs confirm that is reported as a loss."""


def with_refined(scene: Scene, found: Scene) -> Scene:
    """Replace poses and points by those of another scene of the same photographs.

    Images missing there keep their poses; its points become originals without tracks. A scene with
    points stays as it is if all poses are equal.
    """
    posed = {image.name: image for image in found.images}
    pairs = [(image, posed.get(image.name, image)) for image in scene.images]
    if len(scene.points) and all(_same_pose(image, pose) for image, pose in pairs):
        return scene
    images = tuple(
        # Drop observations of the replaced points.
        replace(i, quat=pose.quat, translation=pose.translation, observations=None)
        for i, pose in pairs
    )
    points = PointCloud(found.points.xyz, found.points.rgb)
    return scene.replace(images=images, points=points, tracks=None, left_out=LeftOut())


def _same_pose(a: Image, b: Image) -> bool:
    return np.array_equal(a.quat, b.quat) and np.array_equal(a.translation, b.translation)


def points_without_tracks(scene: Scene) -> PointCloud:
    """Return the distinct originals that are not Structure-from-Motion's."""
    without = scene.points.distinct & (scene.points.source == ORIGINAL)
    if scene.tracks is not None:
        without[: len(scene.tracks)] &= scene.tracks.lengths == 0
    return scene.points.select(without)


def unchanged(scene: Scene) -> Scene:
    """Return the scene as it is, where no colours are wanted."""
    return scene


def add_own_points(
    model_dir: Path, scene: Scene, refined: Sequence[Image], progress: Progress, color: Color
) -> tuple[int, tuple[Finding, ...]]:
    """Add the scene's points without tracks to a COLMAP model, where they stay as ``points_kept``.

    Returns their number, and how photographs fit them if poses changed.
    """
    own, fits = scene.with_points(points_without_tracks(scene)), tuple[Finding, ...]()
    if not len(own.points):
        return 0, ()
    if all(map(_same_pose, scene.images, refined)):
        kept = color(own).points
    else:
        kept, fits = points_kept(scene, refined, "drop", progress, test_every=0, color=color)
    path = model_dir / "points3D.bin"
    points, tracks = read_points3d(path)
    joined = PointCloud.concatenate(points, PointCloud(kept.xyz, kept.rgb))
    write_points3d(path, joined, tracks)
    return len(kept), fits


def points_kept(
    scene: Scene,
    refined: Sequence[Image],
    unfit_points: UnfitPoints,
    progress: Progress,
    *,
    test_every: int,
    color: Color,
) -> tuple[PointCloud, tuple[Finding, ...]]:
    """Return the scene's own points that stay at refined poses, and how photographs fit them.

    Args:
        scene: The scene at the given poses.
        refined: Images with refined poses.
        unfit_points: What to do with points that photographs contradict.
        progress: Called with the stage and the fraction done.
        test_every: Every n-th photograph by name is a test view, and not compared; 0: those that
            the scene lists.
        color: Applied to the scene with points that stay.
    """
    from splatseed.checkup import examination  # noqa: PLC0415  (as above)
    from splatseed.checkup.consistency import Evidence  # noqa: PLC0415

    own = points_without_tracks(scene)
    if not len(own):
        return own, ()
    there = with_refined(scene, scene.replace(images=tuple(refined), points=own))
    images = examination.comparable(there, test_every)
    if len(images) < 2:
        return color(there).points, ()
    evidence = Evidence(there, images)
    checkup = examination.examine(there, images, progress, evidence)
    fitted, findings = examination.fitting(there, checkup, unfit_points)
    kept = color(fitted).points
    if unfit := tuple(each for each in findings if each.kind in {examination.UNFIT_POINTS, _MOVED}):
        return kept, unfit
    if (after := checkup.fit) is None or after.tested < examination.EXAMINATION.min_confirming:
        return kept, ()
    given = {image.name: image.cam_from_world for image in scene.images}
    before = evidence.fit(
        replace(evidence.given, poses=np.array([given[image.name] for image in images])),
        compared=[(pair.first, pair.second) for pair in after.pairs],
    )
    return kept, (_comparison(before, after),)


def _comparison(before: Fit, after: Fit) -> Finding:
    share = (before.confirmed + after.confirmed) / 2
    noise = math.sqrt(2 * share * (1 - share) / after.tested)
    text = (
        f"Photographs confirm {after.confirmed:.0%} of the scene's own points at the refined poses "
        f"and {before.confirmed:.0%} at the given ones, {after.chance:.0%} and {before.chance:.0%} "
        "by chance."
    )
    if before.support - after.support <= max(_LESS, 2 * noise):
        return Finding("points-at-refined-poses", text, "info")
    fix = "They may follow the given poses: `refine_poses=False` keeps these."
    return Finding("points-at-refined-poses", text, fix=fix)
