"""Points on segments and in triangles between nearest neighbours (paper, eqs. 1 and 2)."""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import kernel, parallel_range


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
