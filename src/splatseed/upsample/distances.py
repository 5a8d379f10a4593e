"""The distances of many points from their neighbours: the kernel of ``distances_of``."""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import kernel, parallel_range


@kernel
def fill_distances(xyz, idx, least, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Fill ``out`` [m, k] with max(|x_j - x_i|, least) for the neighbours j of point i."""
    for i in parallel_range(len(idx)):
        for j in range(idx.shape[1]):
            row = idx[i, j]
            x, y, z = xyz[row, 0] - xyz[i, 0], xyz[row, 1] - xyz[i, 1], xyz[row, 2] - xyz[i, 2]
            out[i, j] = max(np.sqrt(x * x + y * y + z * z), least)
