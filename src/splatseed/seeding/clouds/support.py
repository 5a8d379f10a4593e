"""How many points of a cloud lie around each voxel: sparse ghosts have next to none.

Notation: the *support* of a voxel is the number of points in the 27 cells around it, of twice its
side. Promise: exact counts among voxels of one level; those of other levels do not count.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32, Int64

from splatseed.kernels.hashing import FREE, scramble, slot_of
from splatseed.kernels.jit import inline, kernel, parallel_range


def find_support(
    xyz: Float32[np.ndarray, "N 3"], side: Float32[np.ndarray, " N"], count: Int32[np.ndarray, " N"]
) -> Int64[np.ndarray, " N"]:
    """The support of each voxel.

    Args:
        xyz: Positions.
        side: Sides, powers of two.
        count: Points that each holds.
    """
    slots = 1 << int(2 * max(len(xyz), 1)).bit_length()
    keys, sums = np.zeros(slots, np.uint64), np.zeros(slots, np.int64)
    _count(xyz, side, count, keys, sums)
    support = np.empty(len(xyz), np.int64)
    _sum_up(xyz, side, keys, sums, support)
    return support


@inline
def _count(xyz, side, count, keys, sums):  # type: ignore[no-untyped-def]  # Numba's types
    for i in range(len(xyz)):
        key = _key(xyz[i], side[i], 0, 0, 0)
        slot = slot_of(key, keys)
        keys[slot] = key
        sums[slot] += count[i]


@kernel
def _sum_up(xyz, side, keys, sums, support):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(len(xyz)):
        total = np.int64(0)
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    total += sums[slot_of(_key(xyz[i], side[i], a, b, c), keys)]
        support[i] = total


@inline
def _key(point, side, a, b, c):  # type: ignore[no-untyped-def]  # Numba's types
    """A 64-bit key for the cell at an offset from a point's."""
    per_cell = 0.5 / np.float64(side)
    key = scramble(np.uint64(np.int64(np.log2(np.float64(side))) + 4096))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[0] * per_cell)) + a))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[1] * per_cell)) + b))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[2] * per_cell)) + c))
    return max(key, FREE + np.uint64(1))
