"""Kernels of clouds: merging points in voxels, their support, and what a view sees of points."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int16, Int32, UInt64

from splatseed.photos._kernels import project_point
from splatseed.runtime.hashing import FREE, scramble, slot_of
from splatseed.runtime.jit import inline, kernel, parallel_range

# Voxels -------------------------------------------------------------------------------------------

CHUNKS, BLOCK = 64, 512
OUTSIDE = -(1 << 15)  # level of a point in no frame
VOXEL_ORIGIN = 0.381966
"""Where voxels start along each axis: walls at round coordinates would otherwise lie on voxel
faces, and rounding would put their points into either voxel."""


class VoxelTable(NamedTuple):
    """Voxels in the order in which they were first filled, and a hash table to find them."""

    keys: UInt64[np.ndarray, " C"]
    mean: Float32[np.ndarray, "C 3"]
    color: Float32[np.ndarray, "C 3"]  # mean of the points that have one
    counts: Int32[np.ndarray, " C"]
    num_colored: Int32[np.ndarray, " C"]
    level: Int16[np.ndarray, " C"]
    slots: Int32[np.ndarray, " S"]


@kernel
def find_levels(xyz, matrices, sides, sizes, levels):
    """Fill the level of each point's smallest footprint over all views, ``OUTSIDE`` without any."""
    for c in parallel_range(CHUNKS):
        block, footprints = np.empty((3, BLOCK), np.float32), np.empty(BLOCK, np.float32)
        stop = len(xyz) * (c + 1) // CHUNKS
        for start in range(len(xyz) * c // CHUNKS, stop, BLOCK):
            num = min(BLOCK, stop - start)
            for k in range(num):
                footprints[k] = np.float32(np.inf)
                for axis in range(3):
                    block[axis, k] = xyz[start + k, axis]
            for v in range(len(matrices)):
                _lower_footprints(block, matrices[v], sides[v], sizes[v], footprints)
            for k in range(num):
                if footprints[k] < np.inf:
                    levels[start + k] = np.int16(np.floor(np.log2(footprints[k])))


@inline
def _lower_footprints(block, m, side, size, footprints):
    """Lower the footprints of a block to one view's where that is smaller.

    Without branches or divisions, so that it is vectorised: u = (m x) / z is inside if 0 <= m x <
    width z, and the footprint is z / f times the pixels.
    """
    width, height, infinite = size[0], size[1], np.float32(np.inf)
    for k in range(BLOCK):
        x, y, z = block[0, k], block[1, k], block[2, k]
        column = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        row = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        across = (column >= 0) & (column < width * depth)
        inside = across & (row >= 0) & (row < height * depth) & (depth > 0)
        footprints[k] = min(footprints[k], depth * side if inside else infinite)


@inline
def merge_points(start, xyz, rgb, levels, coarsening, voxels, num):
    """Merge points into ``num`` voxels, one after another, from ``start`` on.

    Black points have no colour: scanners store it where they saw none.

    Returns the first point that found no free voxel, or the number of points, and the number of
    voxels.
    """
    has_color = len(rgb) == len(xyz)
    keys, mean, color, counts, num_colored, level, slots = voxels
    for i in range(start, len(xyz)):
        if levels[i] == OUTSIDE:
            continue
        key = _voxel_key(xyz[i], levels[i], coarsening)
        slot = _voxel_slot(key, keys, slots)
        e = slots[slot] - 1
        if e < 0:
            if num == len(keys):
                return i, num
            e = num
            num += 1
            slots[slot], keys[e], level[e], counts[e], num_colored[e] = num, key, levels[i], 0, 0
            for axis in range(3):
                mean[e, axis] = color[e, axis] = np.float32(0.0)
        counts[e] += 1
        share = 1.0 / counts[e]
        for axis in range(3):  # m <- m + (x - m) / n
            mean[e, axis] += (xyz[i, axis] - mean[e, axis]) * share
        if has_color and max(rgb[i, 0], rgb[i, 1], rgb[i, 2]) > 0:
            num_colored[e] += 1
            share = 1.0 / num_colored[e]
            for axis in range(3):
                color[e, axis] += (rgb[i, axis] - color[e, axis]) * share
    return len(xyz), num


@inline
def merge_voxels(old, num, coarsening, new):
    """Merge ``num`` voxels into coarser ones, weighted by their points; return their number."""
    filled = 0
    for i in range(num):
        key = _voxel_key(old.mean[i], old.level[i], coarsening)
        slot = _voxel_slot(key, new.keys, new.slots)
        e = new.slots[slot] - 1
        if e < 0:
            e = filled
            filled += 1
            new.slots[slot], new.keys[e] = filled, key
            new.level[e], new.counts[e], new.num_colored[e] = old.level[i], 0, 0
            for axis in range(3):
                new.mean[e, axis] = new.color[e, axis] = np.float32(0.0)
        new.counts[e] += old.counts[i]
        share = np.float64(old.counts[i]) / new.counts[e]
        for axis in range(3):
            new.mean[e, axis] += (old.mean[i, axis] - new.mean[e, axis]) * share
        if old.num_colored[i] > 0:
            new.num_colored[e] += old.num_colored[i]
            share = np.float64(old.num_colored[i]) / new.num_colored[e]
            for axis in range(3):
                new.color[e, axis] += (old.color[i, axis] - new.color[e, axis]) * share
    return filled


@inline
def _voxel_key(point, level, coarsening):
    """A 64-bit key for the voxel of a point; collisions are too rare to matter."""
    per_side = np.exp2(-np.float64(level + coarsening))
    key = scramble(np.uint64(np.int64(level) + 4096))
    for axis in range(3):
        key = scramble(key ^ np.uint64(np.int64(np.floor((point[axis] + VOXEL_ORIGIN) * per_side))))
    return key


@inline
def _voxel_slot(key, keys, slots):
    """The slot of a key, or the free one where it belongs."""
    last = np.uint64(len(slots) - 1)
    slot = key & last
    while slots[slot] != 0 and keys[slots[slot] - 1] != key:
        slot = (slot + np.uint64(1)) & last
    return slot


# Support ------------------------------------------------------------------------------------------


@inline
def count_by_cell(xyz, side, count, keys, sums):
    """Add the points of each voxel to its cell in a hash table."""
    for i in range(len(xyz)):
        key = _cell_key(xyz[i], side[i], 0, 0, 0)
        slot = slot_of(key, keys)
        keys[slot] = key
        sums[slot] += count[i]


@kernel
def sum_around(xyz, side, keys, sums, support):
    """Add up the points in the 27 cells around each voxel."""
    for i in parallel_range(len(xyz)):
        total = np.int64(0)
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    total += sums[slot_of(_cell_key(xyz[i], side[i], a, b, c), keys)]
        support[i] = total


@inline
def _cell_key(point, side, a, b, c):
    """A 64-bit key for the cell, of twice a voxel's side, at an offset from a point's."""
    per_cell = 0.5 / np.float64(side)
    key = scramble(np.uint64(np.int64(np.log2(np.float64(side))) + 4096))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[0] * per_cell)) + a))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[1] * per_cell)) + b))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[2] * per_cell)) + c))
    return max(key, FREE + np.uint64(1))


# Photo-consistency --------------------------------------------------------------------------------

FREE_SPACE_MARGIN = 0.1  # fraction of a free ray's length within which a point lies at its end
COLOR_TOLERANCE = 32  # grey levels from the median, per channel, within which a sample agrees
NO_VIEW = np.float32(0.0)


@kernel
def observe(
    xyz, matrix, focal, width, height, surface, behind, free, photograph, mask, closeness, samples,
    num_views, violations, confirmations,
):  # fmt: skip
    """Add what one view sees of the points.

    ``free`` [0, 0] if no ray is known to be free, ``mask`` [1, 1] if no pixel is masked,
    ``photograph`` [0, 0, 3] if there are no pixels.
    """
    for k in parallel_range(len(xyz)):
        column, row, depth = project_point(xyz[k], matrix)
        if not (depth > 0.0 and 0.0 <= column < width and 0.0 <= row < height):
            continue
        i, j = int(row), int(column)
        if mask.size > 1 and not mask[i, j]:
            continue
        if free.size > 0:
            end = free[int(row * free.shape[0] / height), int(column * free.shape[1] / width)]
            if depth < end * (1.0 - FREE_SPACE_MARGIN):
                if end < np.inf:
                    violations[k] += 1
            elif depth <= end * (1.0 + FREE_SPACE_MARGIN):
                confirmations[k] += 1
        at = surface[int(row * surface.shape[0] / height), int(column * surface.shape[1] / width)]
        if at < np.inf and depth <= at * (1.0 + behind):
            num_views[k] += 1
            if photograph.size > 0:
                _insert(np.float32(focal / depth), photograph[i, j], closeness[k], samples[k])


@inline
def _insert(close, pixel, closeness, samples):
    """Keep a pixel if its view is among the closest; among equals the earlier stays."""
    k = len(closeness) - 1
    if closeness[k] >= close:
        return
    while k > 0 and closeness[k - 1] < close:
        closeness[k], samples[k] = closeness[k - 1], samples[k - 1]
        k -= 1
    closeness[k], samples[k] = close, pixel


@kernel
def summarise(closeness, samples, rgb, agreement):
    """Fill the robust mean of each point's samples, and the fraction of them that agree."""
    for k in parallel_range(len(closeness)):
        num = 0
        while num < closeness.shape[1] and closeness[k, num] > NO_VIEW:
            num += 1
        if num == 0:
            continue
        median = np.empty(3, np.int64)
        for channel in range(3):
            ordered = np.sort(samples[k, :num, channel])
            median[channel] = ordered[(num - 1) // 2]
        agreeing, total = 0, np.zeros(3, np.int64)
        for s in range(num):
            if _agrees(samples[k, s], median):
                agreeing += 1
                for channel in range(3):
                    total[channel] += samples[k, s, channel]
        for channel in range(3):
            if agreeing > 0:
                rgb[k, channel] = (2 * total[channel] + agreeing) // (2 * agreeing)
            else:
                rgb[k, channel] = median[channel]
        if num > 1:
            agreement[k] = np.float32(agreeing) / np.float32(num)


@inline
def _agrees(sample, median):
    agrees = True
    for channel in range(3):
        agrees &= abs(np.int64(sample[channel]) - median[channel]) <= COLOR_TOLERANCE
    return agrees
