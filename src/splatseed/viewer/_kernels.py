"""Numba kernel of the pictures of points."""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import inline


@inline
def draw_discs(uv, depth, radii, zbuffer, front):
    """Draw a disc for each point; at equal depth the first point stays.

    Args:
        uv: Pixels, float64 [N, 2].
        depth: float64 [N].
        radii: Pixels, float64 [N].
        zbuffer: Depth drawn so far, float64 [H, W]; updated.
        front: Index of the nearest point, int64 [H, W]; updated.
    """
    height, width = front.shape
    for i in range(len(depth)):
        u, v, r = uv[i, 0], uv[i, 1], radii[i]
        column, row = int(np.floor(u)), int(np.floor(v))
        for y in range(max(int(v - r), 0), min(int(v + r) + 1, height)):
            for x in range(max(int(u - r), 0), min(int(u + r) + 1, width)):
                covered = (x + 0.5 - u) ** 2 + (y + 0.5 - v) ** 2 <= r * r
                own = x == column and y == row  # however small, a point is visible
                if (covered or own) and depth[i] < zbuffer[y, x]:
                    zbuffer[y, x] = depth[i]
                    front[y, x] = i
