"""Seeds for a few photographs: one every two pixels, at the depth that semi-global matching finds.

Three photographs confirm a quarter of each other's pixels, and growth has too few views to infer
the rest. So every pixel gets a depth (``depth.stereo.semiglobal``). A seed is left out where an
earlier view has one at that depth, and where another view sees past it and none confirms it.
Promise: the same photographs give the same bytes, whatever the number of threads.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import uniform_filter

from splatseed.camera import Camera
from splatseed.depth.stereo.coarse import downsampled
from splatseed.depth.stereo.semiglobal import semiglobal_depths
from splatseed.methods import source_code
from splatseed.photos.view import View
from splatseed.photos.visibility import points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.sampling import evenly_spaced
from splatseed.seeding.cover import MAX_CONFIDENCE

MAX_PHOTOGRAPHS, MAX_WITH_POINTS = 32, 12
"""Maximum number of photographs that count as few, and where the scene comes with points."""
MIN_ANGLE = 2.0
"""Minimum angle between neighbouring photographs, in degrees (``angle_between``). With photographs
closer together, as of a video, depth between others' seeds is better guessed from these."""
SIDE = 512
"""Longer side of the photographs that are matched, about, in pixels."""
MAX_POINTS, MIN_SHARED = 4_000, 20  # points of which angles are taken, in all and of two views
SPACING = 2  # pixels of these photographs between seeds
SAME_DEPTH = 0.02  # relative difference of depth at which views agree
SEEN_PAST = 0.05  # a seed that much nearer than what a view sees is in front of it


def pixel_seeds(
    views: Sequence[View], xyz: Float64[np.ndarray, "M 3"], progress: Progress
) -> PointCloud:
    """Make the seeds of a few views.

    Args:
        views: Two or more photographs, pinhole.
        xyz: Points of the scene, from which each view's range of depth is taken.
        progress: Called with the stage and the fraction done.

    Returns:
        Seeds of source ``stereo`` where another view's map has the same depth, else ``cover``.
    """
    views = [downsampled(view, SIDE) for view in views]
    depths = semiglobal_depths(views, xyz, progress)
    return PointCloud.concatenate(*(_seeds_of(i, views, depths) for i in range(len(views))))


def are_few(
    cameras: Sequence[Camera], xyz: Float64[np.ndarray, "M 3"], *, has_points: bool
) -> bool:
    """Whether photographs are so few, and so far apart, that each pixel needs a depth.

    ``xyz`` are the scene's points, if it has any, and seeds; without any of these it is False.
    """
    limit = MAX_WITH_POINTS if has_points else MAX_PHOTOGRAPHS
    few = len(xyz) > 0 and 2 <= len(cameras) <= limit
    return few and angle_between(cameras, xyz) >= MIN_ANGLE


def angle_between(cameras: Sequence[Camera], xyz: Float64[np.ndarray, "M 3"]) -> float:
    """Return the angle at which two or more neighbouring cameras see points, in degrees.

    It is the median over the cameras of the second smallest angle to another camera, which is the
    median over the points in both frames; 180 where next to no points are.
    """
    xyz = xyz[evenly_spaced(len(xyz), MAX_POINTS)]
    seen = np.zeros((len(cameras), len(xyz)), bool)
    rays = np.empty((len(cameras), len(xyz), 3))
    for i, camera in enumerate(cameras):
        seen[i, points_in_image(camera, xyz)[0]] = True
        rays[i] = xyz - camera.center
    rays /= np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), np.finfo(float).tiny)
    angles = np.full((len(cameras), len(cameras)), 180.0)
    for i, j in itertools.combinations(range(len(cameras)), 2):
        both = seen[i] & seen[j]
        if both.sum() >= MIN_SHARED:
            cosine = np.median((rays[i, both] * rays[j, both]).sum(axis=1))
            angles[i, j] = angles[j, i] = np.degrees(np.arccos(min(cosine, 1.0)))
    second = np.sort(angles, axis=1)[:, min(2, len(cameras) - 1) - 1]
    return float(np.median(second))


def _seeds_of(
    i: int, views: Sequence[View], depths: Sequence[Float32[np.ndarray, "H W"]]
) -> PointCloud:
    """Make the seeds of view i."""
    view = views[i]
    first = SPACING // 2
    row, column = np.mgrid[first : view.height : SPACING, first : view.width : SPACING]
    row, column = row.ravel(), column.ravel()
    if view.surface is not None:
        shown = view.surface[row, column]
        row, column = row[shown], column[shown]
    uv = np.stack([column, row], axis=1) + 0.5
    xyz = view.camera.unproject(uv, depths[i][row, column].astype(np.float64))
    confirmed, seen_past = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), bool)
    known = np.zeros(len(xyz), bool)
    for j, other in enumerate(views):
        if j == i:
            continue
        index, place, depth = points_in_image(other.camera, xyz)
        across, down = place.astype(np.int64).T
        ratio = depth / depths[j][down, across]
        agrees = np.abs(ratio - 1.0) < SAME_DEPTH
        confirmed[index] += agrees
        seen_past[index] |= ratio < 1.0 - SEEN_PAST
        if j < i:
            known[index] |= agrees
    kept = ~known & (~seen_past | (confirmed > 0))
    smooth = uniform_filter(view.photograph.astype(np.float32), (SPACING, SPACING, 1))
    colors = np.rint(smooth[row, column]).astype(np.uint8)
    source = np.where(confirmed > 0, source_code("stereo"), source_code("cover"))
    belief = np.where(confirmed > 0, 1.0 - 0.5**confirmed, MAX_CONFIDENCE)
    cloud = PointCloud(
        xyz.astype(np.float32),
        colors,
        source.astype(np.uint8),
        confidence=belief.astype(np.float32),
    )
    return cloud.select(kept)
