"""The position (u, v) of a new point on its patch, at which the height is then computed.

Each function takes M uniform draws and returns uv, float32 [M, 2], in scene units relative to the
base point. On a collinear neighbourhood v is 0, since its tangent plane is arbitrary.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float32, Float64

from splatseed.kernels.jit import kernel, parallel_range
from splatseed.upsample.nearest import Draws
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.upsample.surfaces.frames import coordinate

TRIANGLE_NEIGHBORS = 8
"""Neighbours from which the other two corners are drawn."""


def place_on_disc(
    neighbors: Neighbors,
    bases: Bases,
    collinear: Bool[np.ndarray, " n"],
    radius: float,
    rng: Draws,
) -> Float32[np.ndarray, "M 2"]:
    """Uniform in the disc of ``radius`` times the base point's spacing."""
    uv = rng.random((bases.total, 2), dtype=np.float32)
    _disc(radius * neighbors.spacing, collinear, bases.start, bases.count, uv)
    return uv


def place_in_triangle(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    frames: Float64[np.ndarray, "n 3 3"],
    rng: Draws,
) -> Float32[np.ndarray, "M 2"]:
    """Uniform in the triangle of the base and two of its 8 nearest, drawn at random."""
    draws = rng.random((bases.total, 3), dtype=np.float32)
    uv = np.empty((bases.total, 2), np.float32)
    _triangle(cloud.xyz, neighbors.idx[:, :TRIANGLE_NEIGHBORS].copy(), frames,
              bases.start, bases.count, draws, uv)  # fmt: skip
    return uv


def place_in_box(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    frames: Float64[np.ndarray, "n 3 3"],
    rng: Draws,
) -> Float32[np.ndarray, "M 2"]:
    """Uniform in the bounding box of the neighbourhood along e_u and e_v (the paper's text)."""
    uv = rng.random((bases.total, 2), dtype=np.float32)
    _box(cloud.xyz, neighbors.idx, frames, bases.start, bases.count, uv)
    return uv


@kernel
def _disc(radius, collinear, start, count, uv):  # type: ignore[no-untyped-def]  # Numba's types
    """Polar coordinates with a square-root radius, in place of the draws in ``uv``."""
    turn = np.float32(2.0 * math.pi)  # float32 sine and cosine are twice as fast
    for i in parallel_range(len(radius)):
        reach_u = np.float32(radius[i])
        reach_v = np.float32(0.0) if collinear[i] else reach_u
        for m in range(start[i], start[i] + count[i]):
            # The square root makes the area, not the radius, uniform.
            r, angle = np.sqrt(uv[m, 0]), turn * uv[m, 1]
            uv[m, 0] = reach_u * r * np.cos(angle)
            uv[m, 1] = reach_v * r * np.sin(angle)


@kernel
def _triangle(xyz, idx, frames, start, count, draws, uv):  # type: ignore[no-untyped-def]  # Numba's types
    """The square-root map on the triangle of the base and a random pair of its neighbours."""
    pairs = idx.shape[1] * (idx.shape[1] - 1) // 2
    for i in parallel_range(len(idx)):
        for m in range(start[i], start[i] + count[i]):
            pick = min(int(draws[m, 2] * pairs), pairs - 1)
            # Pairs are counted (0,1), (0,2), (1,2), (0,3), ...: second (second - 1) / 2 precede.
            second = int((1.0 + math.sqrt(1.0 + 8.0 * pick)) / 2.0)
            first = pick - second * (second - 1) // 2
            # Weights 1 - sqrt(r1) of the base, at 0, sqrt(r1) (1 - r2) and sqrt(r1) r2.
            root = math.sqrt(np.float64(draws[m, 0]))
            b2 = root * np.float64(draws[m, 1])
            for axis in range(2):
                p = coordinate(xyz, i, idx[i, first], frames[i, axis])
                q = coordinate(xyz, i, idx[i, second], frames[i, axis])
                uv[m, axis] = (root - b2) * p + b2 * q


@kernel
def _box(xyz, idx, frames, start, count, uv):  # type: ignore[no-untyped-def]  # Numba's types
    """Stretch the draws in ``uv`` over the neighbourhood's bounding box."""
    for i in parallel_range(len(idx)):
        for axis in range(2):
            low = high = 0.0
            for j in idx[i]:
                at = coordinate(xyz, i, j, frames[i, axis])
                low, high = min(low, at), max(high, at)
            for m in range(start[i], start[i] + count[i]):
                uv[m, axis] = low + uv[m, axis] * (high - low)
