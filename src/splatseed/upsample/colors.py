"""Colours of new points: inverse-distance weights over the base point and its neighbours.

c = sum_j w_j c_j / sum_j w_j with w_j = 1 / max(|p - p_j|, 0.01 h), h the base point's spacing, in
linear arithmetic on the 8-bit values as the paper has it, rounded to the nearest.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.jit import inline, kernel, parallel_range
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud

__all__ = ["interpolate_colors"]

FLOOR = 0.01
"""Shortest distance that counts, in units of the base point's spacing."""


def interpolate_colors(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    new_xyz: Float32[np.ndarray, "M 3"],
) -> UInt8[np.ndarray, "M 3"]:
    """Colours uint8 [M, 3] of new points at world positions ``new_xyz``."""
    rgb = np.empty((bases.total, 3), np.uint8)
    _interpolate(
        cloud.xyz, cloud.rgb, cloud.center, neighbors.idx, FLOOR * neighbors.spacing,
        bases.start, bases.count, new_xyz, rgb,
    )  # fmt: skip
    return rgb


@kernel
def _interpolate(xyz, rgb, center, idx, floor, start, count, new_xyz, out):  # type: ignore[no-untyped-def]
    for i in parallel_range(len(xyz)):
        if count[i] > 0:
            around, color = _gather(xyz, rgb, i, idx[i])
            for m in range(start[i], start[i] + count[i]):
                _weigh(around, color, new_xyz[m] - center, floor[i], out[m])


@inline
def _gather(xyz, rgb, i, rows):  # type: ignore[no-untyped-def]
    """Positions and colours of a row and its neighbours, once for all its outputs."""
    k = rows.size
    around, color = np.empty((k + 1, 3)), np.empty((k + 1, 3))
    for axis in range(3):
        around[k, axis], color[k, axis] = xyz[i, axis], rgb[i, axis]
        for j in range(k):
            around[j, axis], color[j, axis] = xyz[rows[j], axis], rgb[rows[j], axis]
    return around, color


@inline
def _weigh(around, color, p, floor, out):  # type: ignore[no-untyped-def]
    total = red = green = blue = 0.0
    for j in range(len(around)):
        dx, dy, dz = p[0] - around[j, 0], p[1] - around[j, 1], p[2] - around[j, 2]
        weight = 1.0 / max(math.sqrt(dx * dx + dy * dy + dz * dz), floor)
        total += weight
        red += weight * color[j, 0]
        green += weight * color[j, 1]
        blue += weight * color[j, 2]
    out[0] = np.uint8(red / total + 0.5)
    out[1] = np.uint8(green / total + 0.5)
    out[2] = np.uint8(blue / total + 0.5)
