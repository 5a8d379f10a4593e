"""Kernels of verification (reference views, the slide along the normal) and of cover.

Constants stand here because Numba freezes them into the kernels.
"""

import numpy as np

from splatseed.depth.stereo._kernels.cost import NOISE, SAMPLES, best_cost, prepare_window
from splatseed.photos._kernels import project_point
from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range
from splatseed.runtime.simd import LANES

# Reference views ----------------------------------------------------------------------------------

REFERENCE_VIEWS = 2
"""Views that check a point; the better result counts, as the other may not see the point."""
MIN_SOURCES = 2  # sources of a reference view that must contain the point: they determine its cost
MARGIN = 5.0  # pixels between a point and the frame, so that the window around it lies inside
OBLIQUE_WEIGHT = 0.3  # weight of closeness for a surface seen edge on: normals are uncertain


@kernel
def rank_reference_views(
    xyz, base, normals, order, offsets, matrices, sizes, centers, focals, sources, reference_views
):
    """Fill ``reference_views`` [M, 2] with the best views of each point, best first; -1 for none.

    ``order`` and ``offsets`` list the views of each original (``sources.views_of_points``).
    """
    for i in parallel_range(len(xyz)):
        best = np.zeros(REFERENCE_VIEWS)
        for t in range(offsets[base[i]], offsets[base[i] + 1]):
            view = order[t]
            if not _in_frame(matrices[view], sizes[view], xyz[i]):
                continue
            if not _in_frame_of_sources(xyz[i], sources[view], matrices, sizes):
                continue
            # Pixels per unit of length at the point, weighted by the angle.
            quality = focals[view] * _view_quality(xyz[i], normals[i], centers[view])
            # Insertion into a sorted list of two.
            for k in range(REFERENCE_VIEWS):
                if quality > best[k]:
                    for after in range(REFERENCE_VIEWS - 1, k, -1):
                        best[after] = best[after - 1]
                        reference_views[i, after] = reference_views[i, after - 1]
                    best[k], reference_views[i, k] = quality, view
                    break


@inline
def _in_frame_of_sources(point, sources, matrices, sizes):
    """Whether enough of a view's sources contain a point."""
    count, inside = 0, 0
    for other in sources:
        if other >= 0:
            count += 1
            inside += _in_frame(matrices[other], sizes[other], point)
    return inside > 0 and inside >= min(count, MIN_SOURCES)


@inline
def _in_frame(matrix, size, point):
    """Whether a point lies in front of a camera and within its frame, less ``MARGIN``."""
    u, v, z = project_point(point, matrix)
    inside = MARGIN <= u <= size[0] - MARGIN and MARGIN <= v <= size[1] - MARGIN
    return z > 0.0 and inside


@inline
def _view_quality(point, normal, center):
    """(cos of the angle between ray and normal + ``OBLIQUE_WEIGHT``) / distance."""
    dot, squared = 0.0, 0.0
    for axis in range(3):
        ray = point[axis] - center[axis]
        dot += ray * normal[axis]
        squared += ray * ray
    distance = np.sqrt(squared)
    return (abs(dot) / distance + OBLIQUE_WEIGHT) / distance


# The slide ----------------------------------------------------------------------------------------

MAX_MOVE = 1.5  # spacings
OFFSETS = 13  # offsets tried first, evenly spaced
REFINEMENTS = 4
"""Refinement steps: half a step to both sides of the best is tried, then the step is halved."""
FLOOR = 0.02  # cost of two photographs of one surface: anything lower is chance

_FLOOR, _NOISE, _ONE = np.float32(FLOOR), np.float32(NOISE), np.float32(1.0)


@inline
def slide(quad_images, uv, planes, reach, moves, costs, variances):
    """Find the best offset of each point along its normal.

    Args:
        quad_images: ``stereo.quads.QuadImages``; its grid and bounds are not used.
        uv: Pixels of the points, float32 [M, 2].
        planes: w, gx, gy through each, float32 [M, 3].
        reach: h / (n X), float32 [M], magnitude below 1 / MAX_MOVE.
        moves: Filled with t, float32 [M].
        costs: Filled with the cost there, float32 [M].
        variances: Filled with the variance of the grey levels around the pixel, float32 [M].
    """
    pixels, window = np.zeros((2, LANES), np.float32), np.zeros((2, SAMPLES * LANES), np.float32)
    own, tried = np.zeros((4, LANES), np.float32), np.zeros(3 * LANES, np.float32)
    # Rows: t to try, cost, best value, its t, its cost, the t that half steps start from.
    state = np.zeros((6, LANES), np.float32)
    for first in range(0, len(uv), LANES):
        _fill_lanes(first, uv, planes, reach, pixels, own, state)
        prepare_window(
            quad_images.quads, quad_images.size[0], quad_images.size[1], pixels[0], pixels[1],
            window[0], window[1],
        )  # fmt: skip
        _search_offsets(quad_images, pixels, window, own, tried, state)
        for lane in range(min(LANES, len(uv) - first)):
            moves[first + lane], costs[first + lane] = state[3, lane], state[4, lane]
            variances[first + lane] = _variance(window, lane)


@inline
def _fill_lanes(first, uv, planes, reach, pixels, own, state):
    """Load sixteen points; beyond the end, the last one again."""
    for lane in range(LANES):
        i = min(first + lane, len(uv) - 1)
        pixels[0, lane], pixels[1, lane] = uv[i, 0], uv[i, 1]
        own[0, lane], own[1, lane], own[2, lane] = planes[i, 0], planes[i, 1], planes[i, 2]
        own[3, lane] = reach[i]
        state[2, lane] = np.inf


@inline
def _search_offsets(quad_images, pixels, window, own, tried, state):
    """Try evenly spaced offsets, then ever closer ones around the best."""
    # 13 offsets from -1.5 to 1.5 spacings, a quarter apart; then 1/8, 1/16, 1/32 and 1/64.
    step = np.float32(2.0 * MAX_MOVE / (OFFSETS - 1))
    for k in range(OFFSETS):
        state[0, :] = step * np.float32(k - OFFSETS // 2)
        _accept_if_cheaper(quad_images, pixels, window, own, tried, state)
    for _ in range(REFINEMENTS):
        step *= np.float32(0.5)
        state[5, :] = state[3, :]
        for side in range(2):
            state[0, :] = state[5, :] + (step if side else -step)
            _accept_if_cheaper(quad_images, pixels, window, own, tried, state)


@inline
def _accept_if_cheaper(quad_images, pixels, window, own, tried, state):
    """Evaluate the offsets in ``state[0]``, and keep them where they are better."""
    for lane in range(LANES):
        # w(t) = w / (1 + t h / (n X)), and likewise its slopes
        scale = _ONE / (_ONE + state[0, lane] * own[3, lane])
        for part in range(3):
            tried[part * LANES + lane] = scale * own[part, lane]
    best_cost(
        quad_images.sources, quad_images.sizes, quad_images.offsets, quad_images.warps,
        pixels[0], pixels[1], tried, window[0], window[1], state[1],
    )  # fmt: skip
    for lane in range(LANES):
        t, cost = state[0, lane], state[1, lane]
        # (cost(t) + FLOOR) (1 + t^2): far moves must pay off.
        value = (cost + _FLOOR) * (_ONE + t * t)
        if value < state[2, lane]:
            state[2, lane], state[3, lane], state[4, lane] = value, t, cost


@always_inline
def _variance(window, lane):
    """Variance of a reference window, from its weights c and samples a (``prepare_window``)."""
    # sum a^2 / c = var / (var + NOISE)
    share = np.float32(0.0)
    for k in range(SAMPLES):
        a = window[1, k * LANES + lane]
        share += a * a / window[0, k * LANES + lane]
    # Solved for var; a share of 1 would be infinite variance.
    return _NOISE * share / max(_ONE - share, np.float32(1e-6))


# Cover --------------------------------------------------------------------------------------------

SECTORS = 8


@inline
def guess_depths(
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
