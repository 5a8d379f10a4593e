"""Kernels of verify: the choice of reference views, and the slide along the normal.

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
