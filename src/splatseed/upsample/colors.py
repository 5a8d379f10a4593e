"""Colours of new points: inverse-distance weights over the base point and its neighbours.

c = sum_j w_j c_j / sum_j w_j with w_j = 1 / max(|p - p_j|, 0.01 h), h the base point's spacing, in
linear arithmetic on the 8-bit values as in the paper, rounded to the nearest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud

FLOOR = 0.01
"""Lower limit of distances, in units of the base point's spacing."""


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
def _interpolate(xyz, rgb, center, idx, floor, start, count, new_xyz, out):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(len(count)):
        if count[i] > 0:
            around, color = _gather(xyz, rgb, i, idx[i])
            weight = np.empty(around.shape[1], np.float32)
            # Squared, like the distances it bounds.
            nearest = np.float32(floor[i] * floor[i])
            for m in range(start[i], start[i] + count[i]):
                x = np.float32(new_xyz[m, 0] - center[0] - xyz[i, 0])
                y = np.float32(new_xyz[m, 1] - center[1] - xyz[i, 1])
                z = np.float32(new_xyz[m, 2] - center[2] - xyz[i, 2])
                _weights(around, x, y, z, nearest, weight)
                _mix(weight, color, out[m])


@inline
def _gather(xyz, rgb, i, rows):  # type: ignore[no-untyped-def]  # Numba's types
    """Positions relative to the base [3, k + 1] and colours [k + 1, 3], for all its new points."""
    k = rows.size
    around, color = np.zeros((3, k + 1), np.float32), np.empty((k + 1, 3), np.float32)
    for axis in range(3):
        color[k, axis] = rgb[i, axis]  # the base itself comes last, at the origin
        for j in range(k):
            around[axis, j] = xyz[rows[j], axis] - xyz[i, axis]
            color[j, axis] = rgb[rows[j], axis]
    return around, color


@inline
def _weights(around, x, y, z, nearest, weight):  # type: ignore[no-untyped-def]  # Numba's types
    """Inverse distances; separate from the sums, so that the square roots are vectorised."""
    for j in range(weight.size):
        dx, dy, dz = x - around[0, j], y - around[1, j], z - around[2, j]
        squared = max(dx * dx + dy * dy + dz * dz, nearest)
        weight[j] = np.float32(1.0) / np.sqrt(squared)


@inline
def _mix(weight, color, out):  # type: ignore[no-untyped-def]  # Numba's types
    total = red = green = blue = np.float32(0.0)
    for j in range(weight.size):
        total += weight[j]
        red += weight[j] * color[j, 0]
        green += weight[j] * color[j, 1]
        blue += weight[j] * color[j, 2]
    # Rounded to the nearest, as uint8 cuts off.
    half = np.float32(0.5)
    out[0] = np.uint8(red / total + half)
    out[1] = np.uint8(green / total + half)
    out[2] = np.uint8(blue / total + half)
