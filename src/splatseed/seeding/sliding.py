"""Sliding points along their normals to where photographs agree.

Notation: a point of one view, seen at pixel (u, v), with the plane through it: inverse depth w and
its slopes gx, gy per pixel (``stereo.cost``). Moving the plane by t spacings h along its normal n,
where n X is its distance from the camera, multiplies all three by 1 / (1 + t h / (n X)); the point
then lies where the plane meets the ray of (u, v), so that its window in the view stays the same.
Among the t, the one with the smallest

    (cost(t) + FLOOR) (1 + t^2)

wins: a clearly low cost may move a point, small differences between high costs may not. Promise: a
point's result depends on itself and the photographs, not on its neighbours in the list.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np

from splatseed.depth.stereo.cost import NOISE, SAMPLES, best_cost, prepare_window
from splatseed.runtime.jit import always_inline, inline
from splatseed.runtime.simd import LANES

REACH = 1.5
"""How far a point may move, in spacings."""
OFFSETS = 13
"""Number of offsets tried first, evenly spaced."""
REFINEMENTS = 4
"""Refinement steps: half a step to both sides of the best is tried, then the step is halved."""
FLOOR = 0.02
"""Cost of two photographs of one surface: anything lower is chance."""

_FLOOR, _NOISE, _ONE = (np.float32(each) for each in (FLOOR, NOISE, 1.0))


@inline
def slide(quad_images, uv, planes, reach, moves, costs, variances):
    """The best offset of each point.

    Args:
        quad_images: ``stereo.patchmatch.QuadImages``; its grid and bounds are not used.
        uv: Pixels of the points, float32 [M, 2].
        planes: w, gx, gy through each, float32 [M, 3].
        reach: h / (n X), float32 [M], magnitude below 1 / REACH.
        moves: Filled with t, float32 [M].
        costs: Filled with the cost there, float32 [M].
        variances: Filled with the variance of the grey levels around the pixel, float32 [M].
    """
    places, window = np.zeros((2, LANES), np.float32), np.zeros((2, SAMPLES * LANES), np.float32)
    own, tried = np.zeros((4, LANES), np.float32), np.zeros(3 * LANES, np.float32)
    # Rows: t to try, cost, best value, its t, its cost, the t that half steps start from.
    state = np.zeros((6, LANES), np.float32)
    for first in range(0, len(uv), LANES):
        _fill_lanes(first, uv, planes, reach, places, own, state)
        prepare_window(
            quad_images.quads, quad_images.size[0], quad_images.size[1], places[0], places[1],
            window[0], window[1],
        )  # fmt: skip
        _search(quad_images, places, window, own, tried, state)
        for lane in range(min(LANES, len(uv) - first)):
            moves[first + lane], costs[first + lane] = state[3, lane], state[4, lane]
            variances[first + lane] = _variance(window, lane)


@inline
def _fill_lanes(first, uv, planes, reach, places, own, state):
    """Sixteen points; beyond the end, the last one again."""
    for lane in range(LANES):
        i = min(first + lane, len(uv) - 1)
        places[0, lane], places[1, lane] = uv[i, 0], uv[i, 1]
        own[0, lane], own[1, lane], own[2, lane] = planes[i, 0], planes[i, 1], planes[i, 2]
        own[3, lane] = reach[i]
        state[2, lane] = np.inf


@inline
def _search(quad_images, places, window, own, tried, state):
    """Try evenly spaced offsets, then ever closer ones around the best."""
    # 13 offsets from -1.5 to 1.5 spacings, a quarter apart; then 1/8, 1/16, 1/32 and 1/64.
    step = np.float32(2.0 * REACH / (OFFSETS - 1))
    for k in range(OFFSETS):
        state[0, :] = step * np.float32(k - OFFSETS // 2)
        _try(quad_images, places, window, own, tried, state)
    for _ in range(REFINEMENTS):
        step *= np.float32(0.5)
        state[5, :] = state[3, :]
        for side in range(2):
            state[0, :] = state[5, :] + (step if side else -step)
            _try(quad_images, places, window, own, tried, state)


@inline
def _try(quad_images, places, window, own, tried, state):
    """Accept the offsets tried where they are better."""
    for lane in range(LANES):
        # w(t) = w / (1 + t h / (n X)), and likewise its slopes
        scale = _ONE / (_ONE + state[0, lane] * own[3, lane])
        for part in range(3):
            tried[part * LANES + lane] = scale * own[part, lane]
    best_cost(
        quad_images.sources, quad_images.sizes, quad_images.offsets, quad_images.warps,
        places[0], places[1], tried, window[0], window[1], state[1],
    )  # fmt: skip
    for lane in range(LANES):
        t, cost = state[0, lane], state[1, lane]
        # (cost(t) + FLOOR) (1 + t^2): far moves must pay off.
        value = (cost + _FLOOR) * (_ONE + t * t)
        if value < state[2, lane]:
            state[2, lane], state[3, lane], state[4, lane] = value, t, cost


@always_inline
def _variance(window, lane):
    """Variance of a reference window, from its weights c and samples a (``stereo.cost``)."""
    # sum a^2 / c = var / (var + NOISE)
    share = np.float32(0.0)
    for k in range(SAMPLES):
        a = window[1, k * LANES + lane]
        share += a * a / window[0, k * LANES + lane]
    # Solved for var; a share of 1 would be infinite variance.
    return _NOISE * share / max(_ONE - share, np.float32(1e-6))
