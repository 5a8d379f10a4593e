"""Kernels of projection, of the z-buffer, of the choice of source views, and of undistortion.

Notation: ``matrix`` [3, 4] maps homogeneous world points to (column z, row z, z).
"""

import numpy as np

from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range

# Projection ---------------------------------------------------------------------------------------


@inline
def project_point(point, matrix):
    """Column, row and planar depth of a world point [3], as floats.

    The depth is negative behind the camera; at depth 0 column and row are not finite.
    """
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    # (column z, row z, z) = matrix (x, y, z, 1)
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    inverse = 1.0 / depth
    column = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) * inverse
    row = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) * inverse
    return column, row, depth


@inline
def project_block(xyz, matrix, out):
    """Column, row and depth of points [N, 3] into ``out`` [3, >= N]; vectorised."""
    for k in range(len(xyz)):
        out[0, k], out[1, k], out[2, k] = project_point(xyz[k], matrix)


@always_inline
def cosine_between(point, first, second):
    """Cosine of the angle at a point [3] between the rays to cameras at ``first``, ``second``."""
    dot, first_squared, second_squared = 0.0, 0.0, 0.0
    for axis in range(3):
        a, b = point[axis] - first[axis], point[axis] - second[axis]
        dot += a * b
        first_squared += a * a
        second_squared += b * b
    return dot / np.sqrt(first_squared * second_squared)


# The z-buffer -------------------------------------------------------------------------------------

BLOCK = 512  # points projected at a time, a number that stays in the cache
MAX_DEPTH = 3e38  # depths that float32 can hold
EMPTY = np.float32(np.inf)  # depth of a cell without points


@inline
def find_cells(xyz, matrix, rows, cols, cells, depths):
    """The cell (row by row) and the depth of each point; cell -1 outside the grid or behind it."""
    at = np.empty((3, BLOCK))
    for start in range(0, len(xyz), BLOCK):
        num = min(BLOCK, len(xyz) - start)
        project_block(xyz[start : start + num], matrix, at)
        for k in range(num):
            column, row, depth = at[0, k], at[1, k], at[2, k]
            inside = 0.0 <= column < cols and 0.0 <= row < rows and 0.0 < depth < MAX_DEPTH
            cells[start + k] = int(row) * cols + int(column) if inside else -1
            depths[start + k] = depth


@inline
def sort_by_cell(cells, depths, num_cells):
    """Depths grouped by cell, and the start of each cell's group: a counting sort."""
    starts = np.zeros(num_cells + 1, np.int64)
    for cell in cells:
        if cell >= 0:
            starts[cell + 1] += 1
    for c in range(num_cells):
        starts[c + 1] += starts[c]
    by_cell = np.empty(starts[-1], np.float32)
    free = starts[:-1].copy()  # the next free slot of each cell
    for k in range(len(cells)):
        if cells[k] >= 0:
            by_cell[free[cells[k]]] = depths[k]
            free[cells[k]] += 1
    return starts, by_cell


@inline
def lower_quartiles(starts, by_cell, quartiles):
    """The n // 4-th smallest of each cell's n depths, counted from 0; infinite without points."""
    rows, cols = quartiles.shape
    for i in range(rows):
        for j in range(cols):
            values = by_cell[starts[i * cols + j] : starts[i * cols + j + 1]]
            quartiles[i, j] = _select(values, len(values) // 4) if len(values) else EMPTY


@inline
def _select(values, k):
    """The k-th smallest, by Hoare's quickselect, which reorders the values."""
    low, high = 0, len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]  # halves values that happen to be sorted
        left, right = low, high
        while left <= right:
            while values[left] < pivot:
                left += 1
            while values[right] > pivot:
                right -= 1
            if left <= right:
                values[left], values[right] = values[right], values[left]
                left, right = left + 1, right - 1
        if k <= right:
            high = right
        elif k >= left:
            low = left
        else:
            break
    return values[k]


@inline
def drop_hidden(depths, behind, min_nearer, visible):
    """Copy the depths [rows, cols]; infinite in cells that their neighbours hide.

    A cell is hidden if at least ``min_nearer`` of its eight neighbours are nearer by more than the
    share ``behind`` of its depth.
    """
    rows, cols = depths.shape
    for i in range(rows):
        for j in range(cols):
            # An empty cell is infinitely far and hides nothing; its own limit is infinite too.
            limit = depths[i, j] * np.float32(1.0 - behind)
            nearer = 0
            for a in range(max(i - 1, 0), min(i + 2, rows)):
                for b in range(max(j - 1, 0), min(j + 2, cols)):
                    nearer += depths[a, b] < limit
            visible[i, j] = EMPTY if nearer >= min_nearer else depths[i, j]


# Source views -------------------------------------------------------------------------------------


@kernel
def add_pair_scores(rows, starts, xyz, centers, order, offsets, angles, scores):
    """Add up the score of every pair of views (``sources.choose_sources``) in ``scores`` [V, V]."""
    for i in parallel_range(len(centers)):
        for k in range(starts[i], starts[i + 1]):
            point = rows[k]
            for t in range(offsets[point], offsets[point + 1]):
                j = order[t]
                if j != i:
                    scores[i, j] += _angle_weight(xyz[point], centers[i], centers[j], angles)


@inline
def _angle_weight(point, first, second, angles):
    """Trapezoid over the angle between a point's rays to two cameras; ``angles`` in degrees."""
    cosine = cosine_between(point, first, second)
    angle = np.degrees(np.arccos(min(max(cosine, -1.0), 1.0)))
    low, full, wide, high = angles
    # Nearly parallel rays hardly determine depth.
    rising = min(max((angle - low) / (full - low), 0.0), 1.0)
    # Seen from far apart, a surface looks different.
    falling = min(max((high - angle) / (high - wide), 0.0), 1.0)
    return rising * falling


# Undistortion -------------------------------------------------------------------------------------


@inline
def resample(photograph, uv, out, known):
    """Bilinear colours at positions uv [h, w, 2], NaN = outside; edge pixels reach the border."""
    height, width = photograph.shape[:2]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            u, v = uv[i, j, 0], uv[i, j, 1]
            if not (0.0 <= u <= width and 0.0 <= v <= height):
                continue
            known[i, j] = True
            x = min(max(u - 0.5, 0.0), width - 1.0)  # pixel centres at whole numbers
            y = min(max(v - 0.5, 0.0), height - 1.0)
            left, top = int(x), int(y)
            right, below = min(left + 1, width - 1), min(top + 1, height - 1)
            a, b = x - left, y - top
            for channel in range(3):
                upper = (1 - a) * photograph[top, left, channel] + a * photograph[
                    top, right, channel
                ]
                lower = (1 - a) * photograph[below, left, channel] + a * photograph[
                    below, right, channel
                ]
                out[i, j, channel] = int((1 - b) * upper + b * lower + 0.5)
