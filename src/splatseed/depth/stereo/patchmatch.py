"""PatchMatch: planes are propagated between pixels, or perturbed at random, if that costs less.

Notation: planes (w, gx, gy) float32 [3, h, w] are the inverse depth at a grid point and its slopes
per pixel; costs float32 [h, w]. Grid point (i, j) lies at pixel ((j + 0.5) g, (i + 0.5) g). Points
are red and black as on a chequerboard; a half sweep visits the points of one colour, sixteen of a
row at a time, and reads only the other colour.
Promise: the planes depend only on the photographs, the start and ``key``: random numbers are hashed
from the key and the point, so the order of work is irrelevant.
Source: PatchMatch stereo (Bleyer et al. 2011), in the chequerboard order of Gipuma (Galliani et al.
2015), with the best of each arm as in ACMH (Xu and Tao 2019).
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64

from splatseed.depth.stereo.cost import SAMPLES, best_cost, prepare_window
from splatseed.runtime.hashing import scramble
from splatseed.runtime.jit import always_inline, inline
from splatseed.runtime.simd import LANES

ARM = 11
"""How far a plane may propagate in one visit, in grid points."""
REFINEMENTS = 3
"""Random perturbations of the best plane per visit, each half the size of the one before."""
STEEPEST = 6.0
"""Steepest surface relative to the image plane, as the tangent of the angle: 80 degrees."""
DEPTH_CHANGE, SLOPE_CHANGE = 0.02, 0.5
"""Largest perturbations: a fraction of inverse depth, and of the tangent; halved each sweep."""

# SplitMix64's increment: 2^64 over the golden ratio.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


class QuadImages(NamedTuple):
    """A view and its sources, as kernels take them."""

    quads: Int32[np.ndarray, " P"]
    """The view's quad image, flat."""
    size: Int64[np.ndarray, " 2"]
    """Its width and height."""
    sources: Int32[np.ndarray, " Q"]
    """Quad images of the sources, one after another."""
    sizes: Int64[np.ndarray, "S 2"]
    offsets: Int64[np.ndarray, " S+1"]
    warps: Float32[np.ndarray, "S 12"]
    """A row by row, then b, of each (see ``cost``)."""
    grid: int
    """Pixels between grid points."""
    focal: float
    """Pixels."""
    bounds: Float32[np.ndarray, " 2"]
    """Smallest and largest inverse depth that is tried."""


@inline
def begin(quad_images, guesses, planes, costs):
    """The best of K given planes at each point.

    Args:
        quad_images: ``QuadImages``.
        guesses: float32 [K, 3, h, w].
        planes: Filled, float32 [3, h, w].
        costs: Filled, float32 [h, w].
    """
    height, width = costs.shape
    costs[:] = np.inf
    lanes, places, window, tried, trial_costs = _buffers()
    for row in range(height):
        for first in range(0, width, LANES):
            _fill_lanes(first, 1, width, lanes)
            _look(quad_images, row, lanes, places, window)
            for k in range(len(guesses)):
                for lane in range(LANES):
                    for part in range(3):
                        tried[part * LANES + lane] = guesses[k, part, row, lanes[lane]]
                _try(quad_images, row, lanes, places, window, tried, trial_costs, planes, costs)


@inline
def sweep(quad_images, color, number, key, planes, costs):
    """Visit the points of one colour.

    Args:
        quad_images: ``QuadImages``.
        color: 0 or 1.
        number: The sweep's number, from 0.
        key: uint64, what random numbers are hashed from.
        planes: Changed in place, float32 [3, h, w].
        costs: Likewise, float32 [h, w].
    """
    height, width = costs.shape
    lanes, places, window, tried, trial_costs = _buffers()
    for row in range(height):
        # Every second column of this row has the colour.
        for first in range((row + color) % 2, width, 2 * LANES):
            _fill_lanes(first, 2, width, lanes)
            _look(quad_images, row, lanes, places, window)
            # First what neighbours know, then small changes of the best: 11 planes per visit.
            for way in range(8):
                _propagate(quad_images.grid, way, row, lanes, planes, costs, tried)
                _try(quad_images, row, lanes, places, window, tried, trial_costs, planes, costs)
            for k in range(REFINEMENTS):
                change = 0.5 ** (number + k)
                _perturb(quad_images, row, lanes, change, key + np.uint64(k), planes, tried)
                _try(quad_images, row, lanes, places, window, tried, trial_costs, planes, costs)


@inline
def _buffers():
    """Buffers: lanes' columns, pixels u and v, window weights c and samples a, planes, costs."""
    return (
        np.zeros(LANES, np.int64),
        np.zeros((2, LANES), np.float32),
        np.zeros((2, SAMPLES * LANES), np.float32),
        np.zeros(3 * LANES, np.float32),
        np.zeros(LANES, np.float32),
    )


@inline
def _fill_lanes(first, step, width, lanes):
    """Sixteen columns; beyond the row's end, its last one again."""
    last = first + (width - 1 - first) // step * step
    for lane in range(LANES):
        lanes[lane] = min(first + lane * step, last)


@inline
def _look(quad_images, row, lanes, places, window):
    """Prepare the windows around the points of sixteen lanes."""
    for lane in range(LANES):
        places[0, lane] = (lanes[lane] + 0.5) * quad_images.grid
        places[1, lane] = (row + 0.5) * quad_images.grid
    width, height = quad_images.size[0], quad_images.size[1]
    prepare_window(quad_images.quads, width, height, places[0], places[1], window[0], window[1])


@inline
def _try(quad_images, row, lanes, places, window, tried, trial_costs, planes, costs):
    """Accept the planes tried where they cost less."""
    best_cost(
        quad_images.sources, quad_images.sizes, quad_images.offsets, quad_images.warps,
        places[0], places[1], tried, window[0], window[1], trial_costs,
    )  # fmt: skip
    for lane in range(LANES):
        column = lanes[lane]
        if trial_costs[lane] < costs[row, column] and _allowed(quad_images, tried, lane):
            costs[row, column] = trial_costs[lane]
            for part in range(3):
                planes[part, row, column] = tried[part * LANES + lane]


@always_inline
def _allowed(quad_images, tried, lane):
    """Whether a plane lies within the bounds and is not too steep."""
    w, gx, gy = tried[lane], tried[LANES + lane], tried[2 * LANES + lane]
    if not quad_images.bounds[0] <= w <= quad_images.bounds[1]:
        return False
    # A surface at angle a to the image plane has |(gx, gy)| = w tan(a) / focal.
    limit = STEEPEST * w / quad_images.focal
    return gx * gx + gy * gy <= limit * limit


@inline
def _propagate(grid, way, row, lanes, planes, costs, tried):
    """Neighbours' planes: adjacent to each point (ways 0-3), or the best along an arm (4-7)."""
    height, width = costs.shape
    across, down = _direction(way % 4)
    for lane in range(LANES):
        column = lanes[lane]
        best = 1 if way < 4 else 3
        if way >= 4:
            least = np.float32(np.inf)
            # Odd distances: those points have the other colour, which no lane writes now.
            for far in range(3, ARM + 1, 2):
                y, x = row + far * down, column + far * across
                if 0 <= y < height and 0 <= x < width and costs[y, x] < least:
                    best, least = far, costs[y, x]
        y, x = row + best * down, column + best * across
        # Beyond the border the point's own plane is tried again, which changes nothing.
        if not (0 <= y < height and 0 <= x < width):
            y, x = row, column
        gx, gy = planes[1, y, x], planes[2, y, x]
        # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
        tried[lane] = planes[0, y, x] + grid * (gx * (column - x) + gy * (row - y))
        tried[LANES + lane], tried[2 * LANES + lane] = gx, gy


@always_inline
def _direction(way):
    """Step in columns and rows: right, left, down, up."""
    return (1 - 2 * way if way < 2 else 0), (5 - 2 * way if way >= 2 else 0)


@inline
def _perturb(quad_images, row, lanes, share, key, planes, tried):
    """The points' own planes, perturbed at random: in depth, or in slope as well."""
    width = planes.shape[2]
    for lane in range(LANES):
        column = lanes[lane]
        # Four numbers are set aside per point, three are used: no two draws coincide.
        number = np.uint64(row * width + column) * np.uint64(4)
        w = planes[0, row, column] * (1.0 + DEPTH_CHANGE * share * _random(key, number))
        slope = SLOPE_CHANGE * share * w / quad_images.focal
        tried[lane] = w
        tried[LANES + lane] = planes[1, row, column] + slope * _random(key, number + np.uint64(1))
        tried[2 * LANES + lane] = planes[2, row, column] + slope * _random(
            key, number + np.uint64(2)
        )


@always_inline
def _random(key, number):
    """Uniform in [-1, 1), hashed from a key and a number by SplitMix64."""
    z = scramble(key + number * _GOLDEN)
    # 53 random bits over 2^53, from [0, 1) to [-1, 1).
    return np.float64(z >> np.uint64(11)) * (2.0 / 9007199254740992.0) - 1.0
