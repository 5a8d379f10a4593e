"""Points on segments and in triangles between nearest neighbours (paper, eqs. 1-2), and colours.

Colours by inverse distances: c = sum_j w_j c_j / sum_j w_j over the base point and its neighbours,
w_j = 1 / max(|p - p_j|, floor).
"""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import inline, kernel, parallel_range

# Positions ----------------------------------------------------------------------------------------


@kernel
def sample_segments(xyz, rgb, center, idx, start, count, alpha, out_xyz, out_rgb):
    """P = a P1 + (1 - a) P2 and the same for colours, for all new points of all rows."""
    for i in parallel_range(len(count)):
        j = idx[i, 0]
        for m in range(start[i], start[i] + count[i]):
            a = np.float64(alpha[m])
            for axis in range(3):
                out_xyz[m, axis] = a * xyz[i, axis] + (1.0 - a) * xyz[j, axis] + center[axis]
                color = a * rgb[i, axis] + (1.0 - a) * rgb[j, axis]
                out_rgb[m, axis] = np.uint8(color + 0.5)


@kernel
def sample_triangles(xyz, rgb, center, idx, start, count, draws, out_xyz, out_rgb):
    """P = b0 P1 + b1 P2 + b2 P3 and the same for colours, for all new points of all rows."""
    for i in parallel_range(len(count)):
        p, q = idx[i, 0], idx[i, 1]
        for m in range(start[i], start[i] + count[i]):
            root = np.sqrt(np.float64(draws[m, 0]))
            b1 = root * (1.0 - np.float64(draws[m, 1]))
            b2 = root - b1
            b0 = 1.0 - root
            for axis in range(3):
                out_xyz[m, axis] = (
                    b0 * xyz[i, axis] + b1 * xyz[p, axis] + b2 * xyz[q, axis] + center[axis]
                )
                color = b0 * rgb[i, axis] + b1 * rgb[p, axis] + b2 * rgb[q, axis]
                out_rgb[m, axis] = np.uint8(color + 0.5)


# Colours ------------------------------------------------------------------------------------------


@kernel
def interpolate(xyz, rgb, center, idx, floor, start, count, new_xyz, out):
    """Fill ``out`` uint8 [M, 3] with the colours at world positions ``new_xyz`` [M, 3].

    ``floor`` [n] is the smallest distance that counts, ``idx`` [n, k] the neighbours of each row.
    """
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
def _gather(xyz, rgb, i, rows):
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
def _weights(around, x, y, z, nearest, weight):
    """Inverse distances; separate from the sums, so that the square roots are vectorised."""
    for j in range(weight.size):
        dx, dy, dz = x - around[0, j], y - around[1, j], z - around[2, j]
        squared = max(dx * dx + dy * dy + dz * dz, nearest)
        weight[j] = np.float32(1.0) / np.sqrt(squared)


@inline
def _mix(weight, color, out):
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
