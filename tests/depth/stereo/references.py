"""Stereo's arithmetic once more as literal loops in float64: the specification of its kernels."""

from __future__ import annotations

import math

import numpy as np

from splatseed.depth.stereo._kernels.cost import (
    NOISE,
    NUM_BEST,
    RADIUS,
    SIGMA_GREY,
    SIGMA_SPACE,
    STRIDE,
    UNSEEN_COST,
)

OFFSETS = [
    (STRIDE * i, STRIDE * j) for j in range(-RADIUS, RADIUS + 1) for i in range(-RADIUS, RADIUS + 1)
]
FARTHEST = -5.6
"""Exponents of weights end here."""


def bilinear(image: np.ndarray, column: float, row: float) -> float:
    """A grey image between its pixels, places counted from the centre of the first one."""
    height, width = image.shape
    column, row = min(max(column, 0.0), width - 1.0), min(max(row, 0.0), height - 1.0)
    x, y = math.floor(column), math.floor(row)
    total = 0.0
    for dy in (0, 1):
        for dx in (0, 1):
            share = (1 - abs(column - x - dx)) * (1 - abs(row - y - dy))
            total += share * float(image[min(y + dy, height - 1), min(x + dx, width - 1)])
    return total


def window_weights(image: np.ndarray, u: float, v: float) -> np.ndarray:
    """The weight of each sample of the window around a pixel, summing to 1."""
    center = bilinear(image, u - 0.5, v - 0.5)
    weights = []
    for dx, dy in OFFSETS:
        apart = bilinear(image, u + dx - 0.5, v + dy - 0.5) - center
        exponent = -(apart**2) / (2 * SIGMA_GREY**2) - (dx**2 + dy**2) / (2 * SIGMA_SPACE**2)
        weights.append(math.exp(max(exponent, FARTHEST)))
    return np.array(weights) / sum(weights)


def cost_in(
    image: np.ndarray, other: np.ndarray, warp: np.ndarray, u: float, v: float, plane: np.ndarray
) -> float:
    """One minus the weighted correlation of a window with where a plane puts it in another view.

    ``warp`` is (A | b), [3, 4]; ``plane`` is w0, gx, gy.
    """
    height, width = other.shape
    center = warp @ [u, v, 1.0, plane[0]]
    if center[2] <= 0 or not (
        0 < center[0] / center[2] < width and 0 < center[1] / center[2] < height
    ):
        return UNSEEN_COST
    c = window_weights(image, u, v)
    r, s = [], []
    for dx, dy in OFFSETS:
        w = plane[0] + plane[1] * dx + plane[2] * dy
        x, y, z = warp @ [u + dx, v + dy, 1.0, w]
        r.append(bilinear(image, u + dx - 0.5, v + dy - 0.5))
        s.append(bilinear(other, x / z - 0.5, y / z - 0.5))
    mean_r, mean_s = c @ r, c @ s
    var_r, var_s = c @ (r - mean_r) ** 2, c @ (s - mean_s) ** 2
    covariance = c @ ((r - mean_r) * (s - mean_s))
    return 1.0 - covariance / math.sqrt((var_r + NOISE) * (var_s + NOISE))


def best_of(costs: list[float]) -> float:
    """The mean of the lowest ``NUM_BEST``."""
    return float(np.mean(sorted(costs)[:NUM_BEST]))


def agrees(
    planes: np.ndarray, grid: int, row: int, column: int, warp: np.ndarray, other: np.ndarray
) -> float:
    """How far another map's depth is from that of a pixel of a view, relative; inf where it cannot
    say."""
    z = 1.0 / planes[0, row, column]
    u, v = (column + 0.5) * grid, (row + 0.5) * grid
    x, y, depth = warp @ [u * z, v * z, z, 1.0]
    if depth <= 0:
        return math.inf
    q, p = math.floor(x / depth / grid), math.floor(y / depth / grid)
    if not (0 <= p < other.shape[1] and 0 <= q < other.shape[2]):
        return math.inf
    across, down = x / depth - (q + 0.5) * grid, y / depth - (p + 0.5) * grid
    w = other[0, p, q] + other[1, p, q] * across + other[2, p, q] * down
    return abs(depth * w - 1.0)
