"""The surface around each new point, from the originals there: spacing and normal.

Notation: n originals, M new points; the *base* of a new point is its nearest original, and h, the
mean distance of the base to its 6 nearest, its spacing. The normal is the last principal axis of
the base and its 16 nearest. Promise: each new point's surroundings depend on its own position and
the originals alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.upsample.neighbors import Neighbors, PreparedCloud, prepare
from splatseed.upsample.surfaces.frames import local_frames

NEIGHBORS = 16
"""Neighbours that determine a normal, as for mls."""
FLAT = 0.4
"""A neighbourhood counts as flat up to this ratio of thickness to width; noise alone has about
0.7."""
BLOCK = 1 << 13


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The surroundings of M new points.

    Args:
        base: The nearest original, as its row, int64 [M].
        spacing: h, float64 [M], scene units.
        normals: Unit, of either sign, float64 [M, 3]; NaN where the originals are collinear.
        flat: Whether the originals there are coplanar, bool [M].
    """

    base: Int64[np.ndarray, " M"]
    spacing: Float64[np.ndarray, " M"]
    normals: Float64[np.ndarray, "M 3"]
    flat: Bool[np.ndarray, " M"]


def survey(
    originals: Float64[np.ndarray, "n 3"],
    xyz: Float32[np.ndarray, "M 3"],
    progress: Progress = silent,
) -> Surroundings:
    """The surroundings of each new point.

    Args:
        originals: Distinct finite positions, at least 2.
        xyz: The new points' positions.
        progress: Called with the stage and the fraction done.
    """
    nothing = np.zeros((len(originals), 3), np.uint8)
    cloud = prepare(PointCloud(originals.astype(np.float32), nothing), progress=progress)
    neighbors = cloud.neighbors(NEIGHBORS)
    frames, collinear = local_frames(cloud.xyz, neighbors.idx)
    flat = _thickness(cloud, neighbors, frames, progress) <= FLAT
    rank = _nearest(cloud, xyz, progress)
    # The tree numbers points in file order, neighbours are stored by row.
    row_of_rank = np.argsort(cloud.rank)
    row = row_of_rank[rank]
    normals = np.where(collinear[row, None], np.nan, frames[row, 2])
    return Surroundings(rank, neighbors.spacing[row], normals, (flat & ~collinear)[row])


def _thickness(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    frames: Float64[np.ndarray, "n 3 3"],
    progress: Progress,
) -> Float64[np.ndarray, " n"]:
    """Extent of each neighbourhood along the normal, relative to the second axis."""
    thickness = np.empty(len(cloud))

    def work(start: int, stop: int) -> None:
        near = cloud.xyz[neighbors.idx[start:stop]] - cloud.xyz[start:stop, None]
        # The base itself, at the origin.
        near = np.concatenate([near, np.zeros((stop - start, 1, 3))], axis=1)
        spread = (near @ frames[start:stop, 1:].swapaxes(1, 2)).std(axis=1)
        thickness[start:stop] = spread[:, 1] / np.maximum(spread[:, 0], np.finfo(float).tiny)

    in_threads(work, len(cloud), BLOCK, "look at the originals", progress)
    return thickness


def _nearest(
    cloud: PreparedCloud, xyz: Float32[np.ndarray, "M 3"], progress: Progress
) -> Int64[np.ndarray, " M"]:
    """The original nearest to each point."""
    nearest = np.empty(len(xyz), np.int64)

    def work(start: int, stop: int) -> None:
        nearest[start:stop] = cloud.tree.query(xyz[start:stop] - cloud.center)[1]

    in_threads(work, len(xyz), BLOCK, "find the nearest originals", progress)
    return nearest
