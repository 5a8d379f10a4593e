"""The photometric cost of planes as a scalar Numba loop: pixels, planes, views and samples.

Notation: as in ``depth.stereo._kernels.cost``. Promise: the same cost up to rounding. It is
given what costs nothing to give: weights and likeness of a window are computed once a pixel, not
once a plane.
"""

from __future__ import annotations

import numpy as np

from splatseed.depth.stereo._kernels.cost import (
    MIN_EXPONENT,
    NOISE,
    RADIUS,
    SAMPLES,
    SIDE,
    SIGMA_GREY,
    SIGMA_SPACE,
    STRIDE,
    UNSEEN_COST,
)
from splatseed.runtime.jit import inline

__all__ = ["costs_of_planes"]


@inline
def costs_of_planes(image, others, warps, grid, guesses, out):
    """The mean of the two lowest costs over the sources, of every plane at every grid point.

    Args:
        image: Grey, uint8 [H, W].
        others: Likewise, uint8 [S, H, W].
        warps: (A | b) of each, float64 [S, 3, 4].
        grid: Pixels between grid points.
        guesses: w0, gx, gy, float32 [K, 3, h, w].
        out: Filled, float32 [K, h, w].
    """
    weights, likeness = np.empty(SAMPLES), np.empty(SAMPLES)
    for row in range(guesses.shape[2]):
        for column in range(guesses.shape[3]):
            u, v = (column + 0.5) * grid, (row + 0.5) * grid
            _window(image, u, v, weights, likeness)
            for k in range(len(guesses)):
                plane = guesses[k, :, row, column]
                least, second = 4.0, 4.0
                for s in range(len(others)):
                    cost = _cost(others[s], warps[s], u, v, plane, weights, likeness)
                    if cost < least:
                        least, second = cost, least
                    elif cost < second:
                        second = cost
                out[k, row, column] = 0.5 * (least + second)


@inline
def _window(image, u, v, weights, likeness):
    """The weights c and the likeness a."""
    center = _bilinear(image, u - 0.5, v - 0.5)
    total, mean, square = 0.0, 0.0, 0.0
    for k in range(SAMPLES):
        x, y = STRIDE * (k % SIDE - RADIUS), STRIDE * (k // SIDE - RADIUS)
        r = _bilinear(image, u + x - 0.5, v + y - 0.5)
        exponent = -0.5 * ((r - center) / SIGMA_GREY) ** 2 - 0.5 * (x * x + y * y) / SIGMA_SPACE**2
        c = np.exp(max(exponent, 8 * MIN_EXPONENT))
        weights[k], likeness[k] = c, r
        total, mean, square = total + c, mean + c * r, square + c * r * r
    mean, square = mean / total, square / total
    scale = 1.0 / np.sqrt(max(square - mean * mean, 0.0) + NOISE)
    for k in range(SAMPLES):
        weights[k] /= total
        likeness[k] = weights[k] * (likeness[k] - mean) * scale


@inline
def _cost(image, m, u, v, plane, weights, likeness):
    """One minus the correlation in one source."""
    x, y, z = _moved(m, u, v, plane[0])
    height, width = image.shape
    if not (z > 0 and 0 < x < z * width and 0 < y < z * height):
        return UNSEEN_COST
    like, mean, square = 0.0, 0.0, 0.0
    for k in range(SAMPLES):
        right, down = STRIDE * (k % SIDE - RADIUS), STRIDE * (k // SIDE - RADIUS)
        w = plane[0] + plane[1] * right + plane[2] * down
        x, y, z = _moved(m, u + right, v + down, w)
        s = _bilinear(image, x / z - 0.5, y / z - 0.5)
        like += likeness[k] * s
        mean += weights[k] * s
        square += weights[k] * s * s
    return 1.0 - like / np.sqrt(max(square - mean * mean, 0.0) + NOISE)


@inline
def _moved(m, u, v, w):
    """P = A (u, v, 1) + b w."""
    return (
        m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * w,
        m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * w,
        m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * w,
    )


@inline
def _bilinear(image, column, row):
    height, width = image.shape
    column, row = min(max(column, 0.0), width - 1.0), min(max(row, 0.0), height - 1.0)
    x, y = int(column), int(row)
    right, below = min(x + 1, width - 1), min(y + 1, height - 1)
    a, b = column - x, row - y
    top = image[y, x] + a * (np.float64(image[y, right]) - image[y, x])
    bottom = image[below, x] + a * (np.float64(image[below, right]) - image[below, x])
    return top + b * (bottom - top)
