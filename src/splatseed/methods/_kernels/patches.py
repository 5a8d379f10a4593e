"""Positions (u, v) on patches, and the lift of heights above them to the world.

Row i makes the new points ``start[i] : start[i] + count[i]``; ``frames`` are those of ``frames``.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.methods._kernels.frames import coordinate
from splatseed.runtime.jit import inline, kernel, parallel_range


@kernel
def sample_disc(radius, collinear, start, count, uv):
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
def sample_triangle(xyz, idx, frames, start, count, draws, uv):
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
def sample_box(xyz, idx, frames, start, count, uv):
    """Stretch the draws in ``uv`` over the neighbourhood's bounding box."""
    for i in parallel_range(len(idx)):
        for axis in range(2):
            low = high = 0.0
            for j in idx[i]:
                at = coordinate(xyz, i, j, frames[i, axis])
                low, high = min(low, at), max(high, at)
            for m in range(start[i], start[i] + count[i]):
                uv[m, axis] = low + uv[m, axis] * (high - low)


@kernel
def lift(xyz, center, idx, frames, start, count, uv, height, margin, out):
    """Compute p + u e_u + v e_v + clamp(z) e_n for all new points of all rows."""
    for i in parallel_range(len(count)):
        if count[i] > 0:
            e_u, e_v, e_n = frames[i, 0], frames[i, 1], frames[i, 2]
            low, high = _height_range(xyz, i, idx[i], e_n)
            # No fit is trusted far beyond the heights it was made from.
            slack = margin * (high - low) if margin < np.inf else np.inf
            for m in range(start[i], start[i] + count[i]):
                u, v = np.float64(uv[m, 0]), np.float64(uv[m, 1])
                z = min(max(np.float64(height[m]), low - slack), high + slack)
                for axis in range(3):
                    # p + u e_u + v e_v + z e_n, relative to the centroid until the last sum
                    local = u * e_u[axis] + v * e_v[axis] + z * e_n[axis]
                    out[m, axis] = center[axis] + (xyz[i, axis] + local)


@inline
def _height_range(xyz, i, rows, e_n):
    """Lowest and highest of the neighbours and the base (at 0) along the normal."""
    low = high = 0.0
    for j in rows:
        z = coordinate(xyz, i, j, e_n)
        low = min(low, z)
        high = max(high, z)
    return low, high
