"""Kernels of cover: the depths of empty cells, their colours, and the places of their seeds."""

import numpy as np

from splatseed.photos._kernels import project_point
from splatseed.runtime.jit import inline

SECTORS = 8


@inline
def guess_cell_depths(
    depths, empty, world_from_cells, matrices, shapes, starts, seen, surface, guesses, distances
):
    """Guess the depth of each empty cell (row * cols + column), as ``cover`` defines it.

    ``matrices``, ``shapes`` and ``starts`` are those of the views that may contradict, whose cell
    depths are ``seen``. Fills ``guesses`` and the distances to the nearest covered cells, in cells.
    """
    nearest, depth_of = np.empty(SECTORS), np.empty(SECTORS, np.float32)
    weights, point = np.empty(SECTORS), np.empty(3)
    for k in range(len(empty)):
        i, j = divmod(empty[k], depths.shape[1])
        _nearest_covered(depths, i, j, nearest, depth_of)
        for s in range(SECTORS):
            weights[s] = 0.0
            if nearest[s] < np.inf:
                _lift(world_from_cells, i, j, depth_of[s], point)
                against = _contradictions(point, matrices, shapes, starts, seen, surface)
                # 1 / ((1 + contradictions) distance^2)
                weights[s] = 1.0 / ((1.0 + against) * nearest[s])
        guesses[k] = _weighted_median(depth_of, weights)
        distances[k] = np.sqrt(nearest.min())


@inline
def _lift(m, i, j, depth, point):
    """The point at a depth on the ray through the centre of cell (i, j)."""
    z = np.float64(depth)
    x, y = (j + 0.5) * z, (i + 0.5) * z
    for axis in range(3):
        # X = A z (j + 1/2, i + 1/2, 1) + b
        point[axis] = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]


@inline
def _contradictions(point, matrices, shapes, starts, seen, surface):
    """How many views see through a point to a surface behind it."""
    count = 0
    for v in range(len(matrices)):
        column, row, depth = project_point(point, matrices[v])
        if depth > 0.0:
            rows, cols = shapes[v]
            if 0.0 <= column < cols and 0.0 <= row < rows:
                behind = seen[starts[v] + int(row) * cols + int(column)]
                count += behind < np.inf and depth < behind * (1.0 - surface)
    return count


@inline
def _nearest_covered(depths, i, j, nearest, depth_of):
    """The nearest covered cell of each sector, by squared distance; of equals, ring by ring."""
    for s in range(SECTORS):
        nearest[s] = depth_of[s] = np.inf
    rows, cols = depths.shape
    last = max(i, rows - 1 - i, j, cols - 1 - j)
    ring, found = 1, False
    while ring <= last:
        for a in range(max(i - ring, 0), min(i + ring + 1, rows)):
            # The first and last row of a ring belong to it entirely, the others with both ends.
            step = 1 if abs(a - i) == ring else 2 * ring
            for b in range(j - ring, j + ring + 1, step):
                if 0 <= b < cols and depths[a, b] < np.inf:
                    if not found:
                        # The first covered cell, r = ring away, bounds the search to 2 r + 1.
                        found, last = True, min(last, 2 * ring + 1)
                    sector, square = _sector(a - i, b - j), (a - i) ** 2 + (b - j) ** 2
                    if square < nearest[sector]:
                        nearest[sector], depth_of[sector] = square, depths[a, b]
        ring += 1


@inline
def _sector(dy, dx):
    """The sector of 45 degrees, each including one of its borders; dy and dx are not both 0."""
    if dx > 0 and dy >= 0:
        quarter, u, v = 0, dx, dy
    elif dy > 0:
        quarter, u, v = 1, dy, -dx
    elif dx < 0:
        quarter, u, v = 2, -dx, -dy
    else:
        quarter, u, v = 3, -dy, dx
    return 2 * quarter + (v >= u)


@inline
def _weighted_median(values, weights):
    """The smallest value such that it and all smaller ones hold half of the weight."""
    order = np.argsort(values)
    half = 0.0
    for k in order:
        half += 0.5 * weights[k]
    below = 0.0
    for k in order:
        below += weights[k]
        if below >= half:
            return values[k]
    return values[order[0]]  # never: half of a sum in the same order is no more than the sum


@inline
def mean_colors(image, used, shape, empty, rgb, usable):
    """Average each cell's pixels that count, and tell whether they make up half of it.

    ``used`` [H, W] is False at masked pixels; [1, 1] if there is no mask.
    """
    rows, cols = shape
    height, width = image.shape[:2]
    for k in range(len(empty)):
        i, j = divmod(empty[k], cols)
        total = np.zeros(3, np.int64)
        count, size = 0, 0
        for y in range(i * height // rows, (i + 1) * height // rows):
            for x in range(j * width // cols, (j + 1) * width // cols):
                size += 1
                if used.size == 1 or used[y, x]:
                    count += 1
                    for channel in range(3):
                        total[channel] += image[y, x, channel]
        usable[k] = count > 0 and 2 * count >= size
        for channel in range(3):
            # The mean rounded to the nearest, in integers.
            rgb[k, channel] = (2 * total[channel] + count) // (2 * max(count, 1))


@inline
def lift_cells(m, cols, empty, depths, xyz):
    """Place points at these depths on the rays through the cells' centres."""
    point = np.empty(3)
    for k in range(len(empty)):
        i, j = divmod(empty[k], cols)
        _lift(m, i, j, depths[k], point)
        xyz[k] = point
