"""Which points of a cloud can be used, and what a user should know of it.

Notation: a duplicate has the float32 position of an earlier point. Promise: exact (a hash only
narrows the search), O(N log N), and -0.0 equals 0.0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, UInt64

from splatseed.pointcloud import PointCloud

__all__ = ["UsablePoints", "cloud_warnings", "find_usable"]

_RESOLUTION = 1e-4  # float32 steps coarser than this share of the cloud's extent show in renders
_MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


class UsablePoints(NamedTuple):
    """Which points are kept, and how many are not for which reason."""

    keep: Bool[np.ndarray, " N"]
    num_nonfinite: int
    num_duplicates: int


def find_usable(points: PointCloud) -> UsablePoints:
    """The finite points, and of those at one position the first."""
    keep = points.finite.copy()
    num_finite = int(np.count_nonzero(keep))
    finite_idx = np.flatnonzero(keep)
    keep[finite_idx[_repeats(points.xyz[keep])]] = False
    num_duplicates = num_finite - int(np.count_nonzero(keep))
    return UsablePoints(keep, len(points) - num_finite, num_duplicates)


def _repeats(xyz: Float32[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Which rows equal an earlier row."""
    hashes = _hashes(xyz)
    order = np.argsort(hashes, kind="stable")
    same = np.diff(hashes[order]) == 0
    shared = np.zeros(len(xyz), bool)  # in sorted order: the hash occurs more than once
    shared[1:] |= same
    shared[:-1] |= same
    suspects = np.sort(order[shared])
    repeats = np.zeros(len(xyz), bool)
    if len(suspects):
        _, first = np.unique(xyz[suspects] + np.float32(0.0), axis=0, return_index=True)
        repeats[suspects] = True
        repeats[suspects[first]] = False
    return repeats


def _hashes(xyz: Float32[np.ndarray, "N 3"]) -> UInt64[np.ndarray, " N"]:
    bits = (xyz + np.float32(0.0)).view(np.uint32).astype(np.uint64)  # adding turns -0.0 into 0.0
    products = bits * _MULTIPLIERS  # modulo 2^64
    mixed = products[:, 0] ^ (products[:, 1] >> np.uint64(17)) ^ (products[:, 2] << np.uint64(5))
    return np.asarray(mixed, np.uint64)


def cloud_warnings(points: PointCloud) -> tuple[str, ...]:
    """A sentence on each thing that is wrong with the cloud as a whole."""
    _, num_nonfinite, num_duplicates = find_usable(points)
    warnings = []
    if num_nonfinite:
        warnings.append(f"{num_nonfinite} points are not finite; they are left out when written.")
    if num_duplicates:
        warnings.append(
            f"{num_duplicates:,} points repeat the position of another; they are left out when"
            " written."
        )
    if _is_too_far_out(points):
        warnings.append(
            "The coordinates are so large beside the scene's extent that float32 cannot resolve"
            " it; recentre the scene (subtract an offset from points and cameras) first."
        )
    return tuple(warnings)


def _is_too_far_out(points: PointCloud) -> bool:
    xyz = points.xyz[points.finite]
    if len(xyz) < 2:
        return False
    low, high = np.percentile(xyz, (25, 75), axis=0)
    extent = float((high.astype(np.float64) - low).max())
    step = float(np.spacing(np.abs(xyz).max()))
    return step > _RESOLUTION * extent > 0
