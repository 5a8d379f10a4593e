"""Seeds for a few photographs: one every two pixels, at the depth that semi-global matching finds.

Three photographs confirm a quarter of each other's pixels, and growth has too few views to infer
the rest. So every pixel gets a depth (``depth.stereo.semiglobal``). A seed is left out where an
earlier view has one at that depth, and where another view sees past it and none confirms it.
Promise: the same photographs give the same bytes, whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import uniform_filter

from splatseed.depth.stereo.coarse import downsampled
from splatseed.depth.stereo.semiglobal import semiglobal_depths
from splatseed.methods import source_code
from splatseed.photos.view import View
from splatseed.photos.visibility import points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.seeding.cover import MAX_CONFIDENCE

MAX_PHOTOGRAPHS = 12
"""Maximum number of photographs that count as few."""
SIDE = 512
"""Longer side of the photographs that are matched, about, in pixels."""
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
