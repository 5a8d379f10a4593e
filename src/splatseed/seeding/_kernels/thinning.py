"""Numba kernels of thinning: the views closest to each point, and which points are needed.

``group`` int32 [N, k] holds the views that see a point most closely, closest first, -1 where there
are no more; ``place`` float32 [N, k, 3] the point's column, row and slice of depth there, in
pixels.
"""

from __future__ import annotations

import numpy as np

from splatseed.photos._kernels import project_block
from splatseed.runtime.hashing import FREE, scramble, slot_of
from splatseed.runtime.jit import inline, kernel, parallel_range

DEEP = 4.0
"""Depth of a slice, in cells: deep enough that noise along the ray does not change the slice."""
CHUNKS = 64
"""Parts of the cloud that threads work on."""
BLOCK = 512
"""Points projected at once."""


@kernel
def find_closest(xyz, matrices, focals, sizes, group, place):
    """Fill ``group`` and ``place`` for points [N, 3] and views [V], by depth / focal length."""
    for c in parallel_range(CHUNKS):
        at = np.empty((3, BLOCK))
        stop = len(xyz) * (c + 1) // CHUNKS
        for start in range(len(xyz) * c // CHUNKS, stop, BLOCK):
            num = min(BLOCK, stop - start)
            closeness = np.zeros((num, group.shape[1]))
            for v in range(len(matrices)):
                project_block(xyz[start : start + num], matrices[v], at)
                for k in range(num):
                    inside = 0.0 <= at[0, k] < sizes[v, 0] and 0.0 <= at[1, k] < sizes[v, 1]
                    close = focals[v] / at[2, k]
                    if inside and closeness[k, -1] < close < np.inf:
                        # the scale of depth: a slice is DEEP cells, z / focal each
                        at[2, k] = np.log(at[2, k]) * focals[v] / DEEP
                        _insert(
                            close, v, at[:, k], closeness[k], group[start + k], place[start + k]
                        )


@inline
def _insert(close, v, at, closeness, group, place):
    """Insert a view among the closest; among equals the earlier stays first."""
    k = len(closeness) - 1
    while k > 0 and closeness[k - 1] < close:
        closeness[k], group[k], place[k] = closeness[k - 1], group[k - 1], place[k - 1]
        k -= 1
    closeness[k], group[k] = close, v
    for axis in range(3):
        place[k, axis] = at[axis]


@inline
def keep(order, group, place, spacing, limit, slots, kept):
    """Mark needed points in ``kept``, in order, up to ``limit``; return how many are marked."""
    table = np.full(slots, FREE)
    count = 0
    for i in order:
        if kept[i]:
            count += 1
            _mark_cells(group[i], place[i], spacing, table)
    for i in order:
        if count >= limit:
            break
        if not kept[i] and group[i, 0] >= 0:
            key = _key(group[i, 0], place[i, 0], spacing)
            if table[slot_of(key, table)] == FREE:
                kept[i] = True
                count += 1
                _mark_cells(group[i], place[i], spacing, table)
    return count


@inline
def _mark_cells(group, place, spacing, table):
    for k in range(len(group)):
        if group[k] >= 0:
            key = _key(group[k], place[k], spacing)
            table[slot_of(key, table)] = key


@inline
def _key(group, place, spacing):
    """A 64-bit key for a cell of a view; collisions are not to be expected."""
    key = scramble(np.uint64(group))
    for axis in range(3):
        key = scramble(key ^ np.uint64(np.int64(np.floor(place[axis] / spacing))))
    return max(key, FREE + np.uint64(1))
