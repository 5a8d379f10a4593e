"""PatchMatch: propagate planes between pixels and perturb them; keep those that cost less.

Notation: planes (w, gx, gy) float32 [3, h, w] are the inverse depth at a grid point and its slopes
per pixel; costs float32 [h, w]. Grid point (i, j) lies at pixel ((j + 0.5) g, (i + 0.5) g). Points
are red and black as on a chequerboard; a half sweep visits the points of one colour, sixteen of a
row at a time, and reads only the other colour.
Promise: the planes depend only on the photographs, the initial planes and ``key``: random numbers
are hashed from the key and the point, so the order of visits does not matter.
Source: PatchMatch stereo (Bleyer et al. 2011), in the chequerboard order of Gipuma (Galliani et al.
2015), with the best plane of each arm as in ACMH (Xu and Tao 2019).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64

from splatseed.depth.stereo._kernels.cost import SAMPLES, best_cost, prepare_window
from splatseed.runtime.hashing import scramble
from splatseed.runtime.jit import always_inline, inline
from splatseed.runtime.simd import LANES

ARM_LENGTH = 11
"""Farthest that a plane propagates in one visit, in grid points."""
REFINEMENTS = 3
"""Random perturbations of the best plane per visit; each halves the size."""
MAX_SLOPE = 6.0
"""Steepest surface, as the tangent of its angle to the image plane: 80 degrees."""
DEPTH_CHANGE, SLOPE_CHANGE = 0.02, 0.5
"""Largest perturbations, relative to inverse depth and of the tangent; each sweep halves them."""

# SplitMix64's increment: 2^64 over the golden ratio.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


class QuadImages(NamedTuple):
    """A view and its sources in the kernels' layout."""

    quads: Int32[np.ndarray, " P"]
    """The view's quad image, flat."""
    size: Int64[np.ndarray, " 2"]
    """Its width and height."""
    sources: Int32[np.ndarray, " Q"]
    """Quad images of the sources, concatenated."""
    sizes: Int64[np.ndarray, "S 2"]
    """Width and height of each source."""
    offsets: Int64[np.ndarray, " S+1"]
    """Start of each source in ``sources``."""
    warps: Float32[np.ndarray, "S 12"]
    """A row by row, then b, of each source (see ``cost``)."""
    grid: int
    """Pixels between grid points."""
    focal: float
    """Focal length in pixels."""
    bounds: Float32[np.ndarray, " 2"]
    """Smallest and largest inverse depth."""


@inline
def initialise(quad_images, guesses, planes, costs):
    """Take the cheapest of K given planes at each point.

    Args:
        quad_images: ``QuadImages``.
        guesses: float32 [K, 3, h, w].
        planes: Filled, float32 [3, h, w].
        costs: Filled, float32 [h, w].
    """
    height, width = costs.shape
    costs[:] = np.inf
    lanes, pixels, window, trial, trial_costs = _buffers()
    for row in range(height):
        for first in range(0, width, LANES):
            _fill_lanes(first, 1, width, lanes)
            _load_window(quad_images, row, lanes, pixels, window)
            for k in range(len(guesses)):
                for lane in range(LANES):
                    for part in range(3):
                        trial[part * LANES + lane] = guesses[k, part, row, lanes[lane]]
                _accept_if_cheaper(
                    quad_images, row, lanes, pixels, window, trial, trial_costs, planes, costs
                )


@inline
def red_black_sweep(quad_images, color, number, key, planes, costs):
    """Improve the planes at the points of one colour of the chequerboard.

    Args:
        quad_images: ``QuadImages``.
        color: 0 or 1.
        number: The sweep's number, from 0.
        key: Key of the random numbers, uint64.
        planes: Updated in place, float32 [3, h, w].
        costs: Updated in place, float32 [h, w].
    """
    height, width = costs.shape
    lanes, pixels, window, trial, trial_costs = _buffers()
    for row in range(height):
        # Every second column of this row has the colour.
        for first in range((row + color) % 2, width, 2 * LANES):
            _fill_lanes(first, 2, width, lanes)
            _load_window(quad_images, row, lanes, pixels, window)
            # Planes of neighbours first, then perturbations of the best: 11 planes per visit.
            for direction in range(8):
                _propagate(quad_images.grid, direction, row, lanes, planes, costs, trial)
                _accept_if_cheaper(
                    quad_images, row, lanes, pixels, window, trial, trial_costs, planes, costs
                )
            for k in range(REFINEMENTS):
                scale = 0.5 ** (number + k)
                _perturb(quad_images, row, lanes, scale, key + np.uint64(k), planes, trial)
                _accept_if_cheaper(
                    quad_images, row, lanes, pixels, window, trial, trial_costs, planes, costs
                )


@inline
def _buffers():
    """Allocate columns, pixels (u, v), windows (c, a), candidate planes and their costs."""
    return (
        np.zeros(LANES, np.int64),
        np.zeros((2, LANES), np.float32),
        np.zeros((2, SAMPLES * LANES), np.float32),
        np.zeros(3 * LANES, np.float32),
        np.zeros(LANES, np.float32),
    )


@inline
def _fill_lanes(first, step, width, lanes):
    """Write the columns of sixteen lanes; past the row's end, its last one again."""
    last = first + (width - 1 - first) // step * step
    for lane in range(LANES):
        lanes[lane] = min(first + lane * step, last)


@inline
def _load_window(quad_images, row, lanes, pixels, window):
    """Compute window weights and samples around the points of sixteen lanes."""
    for lane in range(LANES):
        pixels[0, lane] = (lanes[lane] + 0.5) * quad_images.grid
        pixels[1, lane] = (row + 0.5) * quad_images.grid
    width, height = quad_images.size[0], quad_images.size[1]
    prepare_window(quad_images.quads, width, height, pixels[0], pixels[1], window[0], window[1])


@inline
def _accept_if_cheaper(quad_images, row, lanes, pixels, window, trial, trial_costs, planes, costs):
    """Replace the planes of sixteen lanes where the trial planes are valid and cost less."""
    best_cost(
        quad_images.sources, quad_images.sizes, quad_images.offsets, quad_images.warps,
        pixels[0], pixels[1], trial, window[0], window[1], trial_costs,
    )  # fmt: skip
    for lane in range(LANES):
        column = lanes[lane]
        if trial_costs[lane] < costs[row, column] and _is_valid(quad_images, trial, lane):
            costs[row, column] = trial_costs[lane]
            for part in range(3):
                planes[part, row, column] = trial[part * LANES + lane]


@always_inline
def _is_valid(quad_images, trial, lane):
    """Whether a plane is within the depth bounds and not too steep."""
    w, gx, gy = trial[lane], trial[LANES + lane], trial[2 * LANES + lane]
    if not quad_images.bounds[0] <= w <= quad_images.bounds[1]:
        return False
    # A surface at angle a to the image plane has |(gx, gy)| = w tan(a) / focal.
    limit = MAX_SLOPE * w / quad_images.focal
    return gx * gx + gy * gy <= limit * limit


@inline
def _propagate(grid, direction, row, lanes, planes, costs, trial):
    """Write neighbours' planes: adjacent (directions 0-3), or the best of an arm (4-7)."""
    height, width = costs.shape
    across, down = _step(direction % 4)
    for lane in range(LANES):
        column = lanes[lane]
        best = 1 if direction < 4 else 3
        if direction >= 4:
            lowest = np.float32(np.inf)
            # Points at odd distances have the other colour, which this half sweep does not write.
            for step in range(3, ARM_LENGTH + 1, 2):
                y, x = row + step * down, column + step * across
                if 0 <= y < height and 0 <= x < width and costs[y, x] < lowest:
                    best, lowest = step, costs[y, x]
        y, x = row + best * down, column + best * across
        # Beyond the border the point's own plane is tried again, without effect.
        if not (0 <= y < height and 0 <= x < width):
            y, x = row, column
        gx, gy = planes[1, y, x], planes[2, y, x]
        # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
        trial[lane] = planes[0, y, x] + grid * (gx * (column - x) + gy * (row - y))
        trial[LANES + lane], trial[2 * LANES + lane] = gx, gy


@always_inline
def _step(direction):
    """Step in columns and rows: right, left, down, up."""
    column = 1 - 2 * direction if direction < 2 else 0
    row = 5 - 2 * direction if direction >= 2 else 0
    return column, row


@inline
def _perturb(quad_images, row, lanes, scale, key, planes, trial):
    """Write the points' own planes, perturbed at random in depth and slope."""
    width = planes.shape[2]
    for lane in range(LANES):
        column = lanes[lane]
        # A point owns four numbers and uses three, so no two draws coincide.
        number = np.uint64(row * width + column) * np.uint64(4)
        w = planes[0, row, column] * (1.0 + DEPTH_CHANGE * scale * _random(key, number))
        slope = SLOPE_CHANGE * scale * w / quad_images.focal
        trial[lane] = w
        trial[LANES + lane] = planes[1, row, column] + slope * _random(key, number + np.uint64(1))
        trial[2 * LANES + lane] = planes[2, row, column] + slope * _random(
            key, number + np.uint64(2)
        )


@always_inline
def _random(key, number):
    """Hash a key and a number to a uniform number in [-1, 1), by SplitMix64."""
    z = scramble(key + number * _GOLDEN)
    # 53 random bits over 2^53, from [0, 1) to [-1, 1).
    return np.float64(z >> np.uint64(11)) * (2.0 / 9007199254740992.0) - 1.0
