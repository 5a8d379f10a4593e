"""The surface around new points, from the original points: base, spacing, normal, flatness.

Notation: the *base* of a new point is its nearest original, and its spacing h the mean distance of
the base to its 6 nearest. The normal is the last principal axis of the base and its 16 nearest.
Promise: a point's local geometry depends on that point and the originals, not on other points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatseed.methods.neighbors import Neighbors, PreparedCloud, prepare
from splatseed.methods.patches import local_frames
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent

NEIGHBORS = 16  # neighbours that determine a normal, as for mls
MAX_FLATNESS = 0.4
"""Maximum thickness of a flat neighbourhood, relative to its width; noise alone has about 0.7."""
BLOCK = 1 << 13


@dataclass(frozen=True, eq=False)
class LocalGeometry:
    """The originals around M new points."""

    base: Int64[np.ndarray, " M"]  # row of the nearest original
    spacing: Float64[np.ndarray, " M"]  # h
    normals: Float64[np.ndarray, "M 3"]  # unit, of either sign; NaN where originals are collinear
    flat: Bool[np.ndarray, " M"]  # whether the originals are coplanar


def local_geometry(
    originals: Float64[np.ndarray, "n 3"],
    xyz: Float32[np.ndarray, "M 3"],
    progress: Progress = silent,
) -> LocalGeometry:
    """Return the local geometry of each new point, from two or more distinct finite originals."""
    black = np.zeros((len(originals), 3), np.uint8)
    cloud = prepare(PointCloud(originals.astype(np.float32), black), progress=progress)
    neighbors = cloud.neighbors(NEIGHBORS)
    frames, collinear = local_frames(cloud.xyz, neighbors.idx)
    flat = _flatness(cloud, neighbors, frames, progress) <= MAX_FLATNESS
    base = _nearest(cloud, xyz, progress)
    # The tree numbers points in file order, neighbours are stored by row.
    row = np.argsort(cloud.rank)[base]
    normals = np.where(collinear[row, None], np.nan, frames[row, 2])
    return LocalGeometry(base, neighbors.spacing[row], normals, (flat & ~collinear)[row])


def _flatness(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    frames: Float64[np.ndarray, "n 3 3"],
    progress: Progress,
) -> Float64[np.ndarray, " n"]:
    """Return each neighbourhood's extent along the normal, relative to the second axis."""
    flatness = np.empty(len(cloud))

    def work(start: int, stop: int) -> None:
        near = cloud.xyz[neighbors.idx[start:stop]] - cloud.xyz[start:stop, None]
        # The base itself, at the origin.
        near = np.concatenate([near, np.zeros((stop - start, 1, 3))], axis=1)
        spread = (near @ frames[start:stop, 1:].swapaxes(1, 2)).std(axis=1)
        flatness[start:stop] = spread[:, 1] / np.maximum(spread[:, 0], np.finfo(float).tiny)

    in_threads(work, len(cloud), BLOCK, "fit planes to the originals", progress)
    return flatness


def _nearest(
    cloud: PreparedCloud, xyz: Float32[np.ndarray, "M 3"], progress: Progress
) -> Int64[np.ndarray, " M"]:
    """Return the original nearest to each point."""
    nearest = np.empty(len(xyz), np.int64)

    def work(start: int, stop: int) -> None:
        nearest[start:stop] = cloud.tree.query(xyz[start:stop] - cloud.center)[1]

    in_threads(work, len(xyz), BLOCK, "find the nearest originals", progress)
    return nearest
