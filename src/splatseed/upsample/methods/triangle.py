"""Triangular upsampling (paper, eq. 2): a point in the triangle with the two nearest neighbours.

P = b0 P1 + b1 P2 + b2 P3 with (b0, b1, b2) uniform in the triangle; colours likewise. The uniform
barycentric weights come from the square-root map. Promise: every new point lies in the triangle of
three originals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from splatseed.progress import Progress
from splatseed.runtime.jit import kernel, parallel_range
from splatseed.upsample.method import NewPoints
from splatseed.upsample.nearest import NearestMethod, RowData, UniformSource, blended
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud


@dataclass(frozen=True)
class Triangle(NearestMethod):
    """Points in the triangles of originals and their two nearest neighbours (eq. 2).

    Example:
        >>> import numpy as np, splatseed as ss
        >>> xyz = np.array([[0, 0, 5], [1, 0, 5], [0, 1, 5]], np.float32)
        >>> rgb = np.zeros((3, 3), np.uint8)
        >>> more, _ = ss.upsample_points(xyz, rgb, method="triangle", num_points=100)
        >>> len(more), bool((more[:, :2].sum(axis=1) <= 1).all())
        (100, True)
    """

    min_points: ClassVar[int] = 3

    num_neighbors: ClassVar[int] = 2

    def place(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        known: RowData,  # noqa: ARG002  (the base's)
        bases: Bases,
        rng: UniformSource,
        progress: Progress,
    ) -> NewPoints:
        """Make the points of all bases."""
        draws = rng.random((bases.total, 2), dtype=np.float32)
        progress("triangle", 0.0)
        new = blended(_blend, cloud, neighbors, bases, draws)
        progress("triangle", 1.0)
        return new


@kernel
def _blend(xyz, rgb, center, idx, start, count, draws, out_xyz, out_rgb):  # type: ignore[no-untyped-def]  # Numba's types
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
