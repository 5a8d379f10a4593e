"""Linear upsampling (paper, eq. 1): a point on the segment to the nearest neighbour.

P = a P1 + (1 - a) P2 with a ~ U[0, 1], P1 a random original and P2 its nearest neighbour; colours
likewise. Promise: every new point lies between two originals.
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
class Linear(NearestMethod):
    """Points on the segments between originals and their nearest neighbours (eq. 1).

    Example:
        >>> import numpy as np, splatseed as ss
        >>> xyz = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
        >>> rgb = np.array([[0, 0, 0], [255, 255, 255]], np.uint8)
        >>> more, _ = ss.upsample_points(xyz, rgb, method="linear", ratio=4)
        >>> more.shape, bool((more[:, 1:] == 0).all())
        ((8, 3), True)
    """

    num_neighbors: ClassVar[int] = 1

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
        alpha = rng.random(bases.total, dtype=np.float32)
        progress("linear", 0.0)
        new = blended(_blend, cloud, neighbors, bases, alpha)
        progress("linear", 1.0)
        return new


@kernel
def _blend(xyz, rgb, center, idx, start, count, alpha, out_xyz, out_rgb):  # type: ignore[no-untyped-def]  # Numba's types
    """P = a P1 + (1 - a) P2 and the same for colours, for all new points of all rows."""
    for i in parallel_range(len(count)):
        j = idx[i, 0]
        for m in range(start[i], start[i] + count[i]):
            a = np.float64(alpha[m])
            for axis in range(3):
                out_xyz[m, axis] = a * xyz[i, axis] + (1.0 - a) * xyz[j, axis] + center[axis]
                color = a * rgb[i, axis] + (1.0 - a) * rgb[j, axis]
                out_rgb[m, axis] = np.uint8(color + 0.5)
