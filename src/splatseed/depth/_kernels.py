"""Numba kernels of the method ``depth``: drawing pixels, comparing views, sorting points in cubes.

Notation: a map is [H, W] planar depth; a pixel's number is row * W + column. A *reduced* map [h, w]
has its points at whole columns and rows; ``grid_from_world`` [3, 4] maps world points to
(column z, row z, z) there. Candidates are points [C, 3] lifted from the pixels of one view.
Promise: random numbers are arguments, so results do not depend on threads.
"""

from __future__ import annotations

import numpy as np

from splatseed.photos._kernels import cosine_between, project_point
from splatseed.runtime.hashing import scramble
from splatseed.runtime.jit import inline, kernel, parallel_range

# Drawing pixels -----------------------------------------------------------------------------------

DIAGONAL = 2.0**0.5
"""Length of a diagonal step, in cells."""


@inline
def chamfer_distance(distance):
    """Replace a grid's values by their distance to its zeros, at most 8% too long.

    Source: two passes over the grid (Borgefors, 1986).

    Args:
        distance: 0 at the sources, else infinite, float64 [rows, columns]; updated in place.
    """
    rows, columns = distance.shape
    # Forward from the upper left, then backward from the lower right.
    for sweep in range(2):
        for a in range(rows):
            row = a if sweep == 0 else rows - 1 - a
            previous_row = row - 1 if sweep == 0 else row + 1
            for b in range(columns):
                column = b if sweep == 0 else columns - 1 - b
                previous_column = column - 1 if sweep == 0 else column + 1
                shortest = distance[row, column]
                if 0 <= previous_column < columns:
                    shortest = min(shortest, distance[row, previous_column] + 1.0)
                if 0 <= previous_row < rows:
                    shortest = min(shortest, distance[previous_row, column] + 1.0)
                    if column > 0:
                        shortest = min(shortest, distance[previous_row, column - 1] + DIAGONAL)
                    if column < columns - 1:
                        shortest = min(shortest, distance[previous_row, column + 1] + DIAGONAL)
                distance[row, column] = shortest


@inline
def draw_pixels(values, cumulative, columns, step, box, picks, jitter, radius, tolerance, out):
    """Draw distinct pixels with depth from weighted cells, away from discontinuities.

    Args:
        values: Depth, NaN where unknown, float32 [H, W].
        cumulative: Cumulative weight of the cells, row by row, float64 [rows * columns].
        columns: Cells in a row.
        step: Side of a cell in pixels.
        box: First and last row and column to draw from: top, left, bottom, right.
        picks: Ascending numbers up to the total weight, float64 [P]; each picks a cell.
        jitter: Position within the cell, in [0, 1), float32 [P, 2].
        radius: Of the discontinuity test, pixels; 0 = no test.
        tolerance: Of the discontinuity test, relative depth.
        out: Filled with the pixels' numbers, int64 [P].

    Returns:
        The number of pixels written.
    """
    top, left, bottom, right = box
    cell, count, first = 0, 0, 0  # out[first:count] belong to this cell
    for k in range(len(picks)):
        while cell < len(cumulative) - 1 and cumulative[cell] <= picks[k]:
            cell += 1
            first = count
        row = cell // columns * step + int(jitter[k, 0] * step)
        column = cell % columns * step + int(jitter[k, 1] * step)
        if row < top or row >= bottom or column < left or column >= right:
            continue
        pixel = row * values.shape[1] + column
        if not 0 < values[row, column] < np.inf or _contains(out[first:count], pixel):
            continue
        if radius == 0 or not _is_near_edge(values, row, column, radius, tolerance):
            out[count] = pixel
            count += 1
    return count


@inline
def _contains(numbers, number):
    for element in numbers:  # noqa: SIM110  (Numba has no any() of a generator)
        if element == number:
            return True
    return False


@inline
def find_edges(values, pixel, radius, tolerance, out):
    """Write whether each pixel (a number) lies near a depth discontinuity, bool [C]."""
    width = values.shape[1]
    for k in range(len(pixel)):
        row, column = pixel[k] // width, pixel[k] % width
        out[k] = radius > 0 and _is_near_edge(values, row, column, radius, tolerance)


@inline
def _is_near_edge(values, row, column, radius, tolerance):
    """Whether 1 / depth bends within ``radius``, across, down or diagonally, or is mostly unknown.

    All distances are tested along the row, where memory is near, and only the largest one
    elsewhere: there, a discontinuity that is crossed twice can be missed.
    """
    # w(-k) + w(+k) - 2 w(0), relative to w(0): 0 on any plane
    here = 2.0 / values[row, column]
    known, pairs = 0, 0
    for k in range(1, radius + 4):
        dy, dx = 0, k
        if k > radius:
            dy, dx = radius, radius * (k - radius - 2)
        y0, x0, y1, x1 = row - dy, column - dx, row + dy, column + dx
        if y0 < 0 or y1 >= values.shape[0] or min(x0, x1) < 0 or max(x0, x1) >= values.shape[1]:
            continue
        pairs += 1
        before, after = values[y0, x0], values[y1, x1]
        if 0 < before < np.inf and 0 < after < np.inf:
            known += 1
            if abs(1.0 / before + 1.0 / after - here) > 0.5 * tolerance * here:
                return True
    # Unknown depth may hide an edge.
    return 2 * known < pairs


# Neighbours ---------------------------------------------------------------------------------------

FULL_ANGLE = 0.03
"""1 - cos of the angle between rays from which on (14 degrees) a view covers fully, up to 60."""
MIN_ANGLE_WEIGHT = 0.05
"""Weight of rays that coincide."""
SAME_SURFACE = 0.25
"""A view sees a sample if its own depth there differs by less than this fraction."""
MAX_COLUMNS = 1e6
"""More columns than any grid has."""


@kernel
def shortlist_views(samples, matrices, sizes, centers, out):
    """Choose, for each view, views whose frames cover its samples; occlusion is ignored.

    Args:
        samples: World points of each view, float32 [V, S, 3].
        matrices: ``grid_from_world`` of each view, float64 [V, 3, 4].
        sizes: Rows and columns of each grid, int64 [V, 2].
        centers: Of the cameras, float64 [V, 3].
        out: Filled with the views chosen, best first, int64 [V, K], -1 before.
    """
    num, per_view = samples.shape[0], samples.shape[1]
    for i in parallel_range(num):
        covers = np.zeros((num, per_view))
        for j in range(num):
            if j != i:
                frame_weights(samples[i], matrices[j], sizes[j], centers[i], centers[j], covers[j])
        choose_covering(covers, out[i])


@inline
def choose_covering(covers, out):
    """Choose rows greedily by the sum of w / (1 + covered)^2, until no row adds anything.

    Args:
        covers: Weight w with which each view covers each sample, float64 [V, S].
        out: Filled with rows, int64 [K]; entries that no row fills stay.
    """
    covered, worth = np.zeros(covers.shape[1]), np.ones(covers.shape[1])
    free = np.ones(len(covers), np.bool_)
    for k in range(min(len(out), len(covers))):
        best, best_gain = -1, 0.0
        for j in range(len(covers)):
            if free[j]:
                gain = 0.0
                for s in range(covers.shape[1]):
                    gain += covers[j, s] * worth[s]
                if gain > best_gain:
                    best, best_gain = j, gain
        if best < 0:
            break
        out[k] = best
        free[best] = False
        covered += covers[best]
        # A sample that one full neighbour covers is worth a quarter to the next.
        worth = 1.0 / (1.0 + covered) ** 2


@inline
def frame_weights(samples, m, size, center, other, out):
    """Write the weight with which a view covers each sample, by frame and angle, float64 [S]."""
    for s in range(len(samples)):
        depth, column, row = _nearest_grid_point(samples[s], m)
        if 0.0 < depth < np.inf and 0 <= column < size[1] and 0 <= row < size[0]:
            out[s] = _angle_weight(samples[s], center, other)


@inline
def drop_occluded(samples, m, z, factor, out):
    """Set the weight of samples to 0 where the view's own depth, ``factor * z``, differs."""
    for s in range(len(samples)):
        if out[s] > 0.0:
            depth, column, row = _nearest_grid_point(samples[s], m)
            if not abs(factor * z[row, column] / depth - 1.0) < SAME_SURFACE:
                out[s] = 0.0


@inline
def _nearest_grid_point(point, m):
    """Depth of a point in a view, and the nearest grid point; column -1 outside of any grid."""
    column, row, depth = project_point(point, m)
    column, row = column + 0.5, row + 0.5
    if not (0.0 <= column < MAX_COLUMNS and 0.0 <= row < MAX_COLUMNS):
        return depth, -1, -1
    return depth, int(column), int(row)


@inline
def _angle_weight(point, first, second):
    """Small where the rays coincide, rising to 1, and 0 where they are 90 degrees apart."""
    # Errors of depth seen from one place are alike; beyond 90 degrees lies a surface's other side.
    cosine = cosine_between(point, first, second)
    rising = min(max((1.0 - cosine) / FULL_ANGLE, MIN_ANGLE_WEIGHT), 1.0)
    return rising * min(max(2.0 * cosine, 0.0), 1.0)


# Scales -------------------------------------------------------------------------------------------

SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation of a normal variable over the median of its absolute value."""
MAX_LOG_RATIO = 0.25
"""Larger log ratios of depth come from different surfaces."""
MIN_COMMON = 12
"""Common samples that a pair of views needs."""
MIN_PAIR_SIGMA = 0.005
"""Smallest standard error of a pair that is trusted."""
INDEPENDENT = 0.1
"""Fraction of the samples that counts as independent: neighbouring pixels have similar errors."""


@inline
def compare_pair(samples, z, factor, m, out):
    """Write the median log ratio a of a pair of views and its standard error, float64 [2].

    ``samples`` [S, 3] are points of the first view; ``factor * z`` is the second view's depth and
    ``m`` its ``grid_from_world``. ``out`` stays as it is where too few samples overlap.
    """
    logs = np.empty(len(samples))
    count = 0
    for k in range(len(samples)):
        across, down, depth = project_point(samples[k], m)
        if depth <= 0.0:
            continue
        # The nearest grid point: they lie at whole numbers.
        column, row = int(np.floor(across + 0.5)), int(np.floor(down + 0.5))
        if not (0 <= column < z.shape[1] and 0 <= row < z.shape[0] and z[row, column] > 0):
            continue
        # log d_j / z_ij
        log = np.log(factor * z[row, column] / depth)
        if abs(log) <= MAX_LOG_RATIO:
            logs[count] = log
            count += 1
    if count >= MIN_COMMON:
        out[0] = np.median(logs[:count])
        # Robust standard error of a median of INDEPENDENT count samples.
        spread = SIGMA_OF_MEDIAN * np.median(np.abs(logs[:count] - out[0]))
        out[1] = max(spread / np.sqrt(INDEPENDENT * count), MIN_PAIR_SIGMA)


# Support ------------------------------------------------------------------------------------------

SEE_THROUGH_FACTOR = 2.0
"""Tolerances beyond which a view sees clearly farther than a point: both depths have errors."""
UNDECIDED, CONFIRMS, SEES_THROUGH = range(3)


@inline
def own_colors(xyz, grid_from_world, rgb, rgb_from_grid, out):
    """Write a view's own reduced colours at its candidates, as smooth as those of other views.

    Args:
        xyz: Candidates, float32 [C, 3].
        grid_from_world: float64 [3, 4].
        rgb: The reduced photograph, uint8 [p, q, 3].
        rgb_from_grid: Factor and offset of columns, then of rows, float64 [2, 2].
        out: uint8 [C, 3].
    """
    for k in range(len(xyz)):
        column, row, _ = project_point(xyz[k], grid_from_world)
        p, q = _rgb_pixel(column, row, rgb_from_grid, rgb.shape)
        for channel in range(3):
            out[k, channel] = rgb[p, q, channel]


@inline
def add_support(
    xyz, own, z, factor, grid_from_world, rgb, rgb_from_grid, tolerance, limit, enough,
    only_unconfirmed, agreeing, seen_through,
):  # fmt: skip
    """Compare all candidates with one other view.

    Args:
        xyz: Candidates, float32 [C, 3].
        own: Their colours in their own view, uint8 [C, 3].
        z: The other view's reduced map, float32 [h, w].
        factor: Scene units per unit of ``z``.
        grid_from_world: Of the other view, float64 [3, 4].
        rgb: Its reduced photograph, uint8 [p, q, 3].
        rgb_from_grid: Factor and offset of columns, then of rows, float64 [2, 2].
        tolerance: Relative difference of depth up to which views agree.
        limit: Sum of the channels' differences up to which colours agree.
        enough: Confirmations that are counted at most.
        only_unconfirmed: Whether to skip candidates that have ``enough``.
        agreeing: Confirmations of each, uint8 [C], updated in place.
        seen_through: Whether a view sees through each, bool [C], updated in place.
    """
    height, width = z.shape
    for k in range(len(xyz)):
        if only_unconfirmed and agreeing[k] >= enough:
            continue
        column, row, depth = project_point(xyz[k], grid_from_world)
        if depth > 0.0 and -0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5:
            # In the map's own units: one division here instead of four multiplications.
            verdict = _compare_depth(z, column, row, depth / factor, tolerance)
            if verdict == SEES_THROUGH:
                seen_through[k] = True
            elif verdict == CONFIRMS and agreeing[k] < enough:
                p, q = _rgb_pixel(column, row, rgb_from_grid, rgb.shape)
                agreeing[k] += _color_error(own[k], rgb[p, q]) <= limit


@inline
def _compare_depth(z, column, row, depth, tolerance):
    """Compare a depth with the four map values around a grid position; NaN decides nothing."""
    x0 = min(max(int(np.floor(column)), 0), max(z.shape[1] - 2, 0))
    y0 = min(max(int(np.floor(row)), 0), max(z.shape[0] - 2, 0))
    x1, y1 = min(x0 + 1, z.shape[1] - 1), min(y0 + 1, z.shape[0] - 1)
    a, b, c, d = z[y0, x0], z[y0, x1], z[y1, x0], z[y1, x1]
    # One agreeing corner confirms; all four must be farther to see through.
    near = tolerance * depth
    if (
        abs(a - depth) <= near
        or abs(b - depth) <= near
        or abs(c - depth) <= near
        or abs(d - depth) <= near
    ):
        return CONFIRMS
    far = depth + SEE_THROUGH_FACTOR * near
    if a > far and b > far and c > far and d > far:
        return SEES_THROUGH
    return UNDECIDED


@inline
def _rgb_pixel(column, row, rgb_from_grid, shape):
    """Row and column of the reduced photograph at a grid position."""
    p = int(np.floor(row * rgb_from_grid[1, 0] + rgb_from_grid[1, 1]))
    q = int(np.floor(column * rgb_from_grid[0, 0] + rgb_from_grid[0, 1]))
    return min(max(p, 0), shape[0] - 1), min(max(q, 0), shape[1] - 1)


@inline
def _color_error(first, second):
    total = np.int64(0)
    for channel in range(3):
        total += abs(np.int64(first[channel]) - np.int64(second[channel]))
    return total


# Cubes --------------------------------------------------------------------------------------------

POSITION_BITS = 21
"""Bits of a cube's position along one axis: three fit into 64."""
OUTSIDE = 2.0**20 + 2
"""Position of points beyond every candidate's cube: at the finest side there are 2^20 cubes."""


@kernel
def cube_keys(xyz, low, side, out):
    """Write the key of the cube of each point, uint64 [N].

    Args:
        xyz: Points, float32 [N, 3].
        low: Lower corner of the candidates' box, float64 [3]; the cubes start there.
        side: Side of a cube.
        out: A cube's scrambled position. Points outside of the box get keys of their own.
    """
    for k in parallel_range(len(xyz)):
        key = np.uint64(0)
        for axis in range(3):
            position = np.floor((np.float64(xyz[k, axis]) - low[axis]) / side)
            clamped = min(max(position, -1.0), OUTSIDE)
            key = (key << np.uint64(POSITION_BITS)) | np.uint64(clamped + 1.0)
        out[k] = scramble(key)
