"""A scene at refined poses: ``refined``."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from splatseed.checkup.choices import UnfitPoints
from splatseed.findings import Finding
from splatseed.io.photograph import photograph_folder
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.scene import Image, Masks, Scene
from splatseed.sfm import colmap
from splatseed.sfm.child import WORK, call
from splatseed.sfm.colmap import ColmapRun, Settings
from splatseed.sfm.export import drop_repeats
from splatseed.sfm.matching import match_photographs
from splatseed.sfm.own_points import Color, points_kept, unchanged, with_refined
from splatseed.sfm.photos import find_photos, match_poses
from splatseed.sfm.refinement import Refinement, refine, unrefined_finding


class RefinedScene(NamedTuple):
    """A scene at refined poses."""

    scene: Scene
    num_kept: int  # points of its own that stay, the first; the others were triangulated
    findings: tuple[Finding, ...]


def refined(
    scene: Scene,
    seed: int,
    progress: Progress = silent,
    *,
    test_every: int = 0,
    unfit_points: UnfitPoints = "drop",
    color: Color = unchanged,
) -> RefinedScene:
    """Return the scene at refined poses, and what was done.

    Where refinement gains nothing, the scene keeps its poses, and its points if it has any. Else
    points are triangulated from its photographs' features. They replace those with tracks, which
    were triangulated at the given poses; others (LiDAR, a mesh) come first and stay, as refined
    poses are in the given frame, if photographs do not contradict them there. Photographs, lenses
    and depth maps stay. The test views, every ``test_every``-th (0: none) or those of the scene's
    list, are refined with the others, but contribute no triangulated point.

    Args:
        scene: The scene.
        seed: The seed of RANSAC and bundle adjustment.
        progress: Called with the stage and the fraction done.
        test_every: How often a photograph is a test view.
        unfit_points: What to do with its own points if photographs contradict them.
        color: Gives colours to its own points at refined poses where they lack them.

    Raises:
        SceneNotFoundError: It has no photographs.
        ReconstructionError: The poses drifted, or no point could be triangulated.
        MissingDependencyError: pycolmap is absent.
    """
    require("pycolmap")
    folder, own = photograph_folder(scene).absolute(), int(scene.points.distinct.sum())
    test = scene.split(test_every)[1]
    photos, _ = find_photos(folder)
    poses = match_poses(photos, scene, folder)
    with TemporaryDirectory(prefix="splatseed-refine-") as name:
        (Path(name) / WORK).mkdir()
        names = {image.name for image in test}
        settings = Settings(seed=seed).for_poses(photos)
        child = (folder, Path(name), settings, progress, None, _refine)
        found: _Refined = call(*child, poses, names, scene.masks, own > 0)
    change, kept, count = found.refinement, scene.points, f"{len(found.points):,}"
    fits: tuple[Finding, ...] = ()
    if change.kept:
        what = "Poses and points stay" if own else f"{count} points were triangulated; poses stay"
        how = f"{what} as given: refined poses gain less than 0.1 px of reprojection error."
    else:
        kept, fits = points_kept(
            scene, found.poses, unfit_points, progress, test_every=test_every, color=color
        )
        how = (
            f"{_what_stays(own, len(kept), count)} at refined poses, which lower the mean "
            f"reprojection error from {change.error_before:.2f} to {change.error_after:.2f} "
            f"px: cameras turned by {change.median_turn:.2f} degrees and moved by "
            f"{change.median_shift:.3g} units, both the median."
        )
        others = {image.name for image in scene.images} - {image.name for image in poses}
        unread = [name for name in sorted(others) if (folder / name).is_file()]
        if unrefined := unrefined_finding(len(scene.images), change.excluded, unread):
            how = f"{how} {unrefined}"
    points = PointCloud.concatenate(kept, found.points)  # if poses stay, the scene is returned
    scene = with_refined(scene, scene.replace(images=found.poses, points=points))
    return RefinedScene(scene, len(kept), (Finding("refined-poses", how, "info"), *fits))


def _what_stays(own: int, kept: int, triangulated: str) -> str:
    """Begin a sentence about the scene's points and those triangulated."""
    if not own:
        return f"{triangulated} points are triangulated"
    if kept == own:
        return f"The scene's {own:,} points stay, beside {triangulated} triangulated"
    which = f"{own - kept:,} of the scene's {own:,}" if kept else f"The scene's {own:,}"
    return f"{which} points are replaced by {triangulated} triangulated"


class _Refined(NamedTuple):
    poses: tuple[Image, ...]
    points: PointCloud
    refinement: Refinement


def _refine(
    run: ColmapRun,
    _: Path,
    poses: Sequence[Image],
    test_names: Collection[str],
    masks: Masks | None,
    has_points: bool,
) -> _Refined:
    match_photographs(run, colmap.posed_model(run.pycolmap, poses), masks, poses)
    poses, refinement = refine(run, poses)
    if refinement.kept and has_points:  # which stay
        return _Refined(tuple(poses), PointCloud.empty(), refinement)
    model = run.pycolmap.Reconstruction(colmap.triangulate_points(run, poses, test_names))
    drop_repeats(model)
    points = [point for _, point in sorted(model.points3D.items())]
    xyz = np.array([point.xyz for point in points], np.float32)
    cloud = PointCloud(xyz, np.array([point.color for point in points], np.uint8))
    return _Refined(tuple(poses), cloud.select(cloud.distinct), refinement)
