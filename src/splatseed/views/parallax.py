"""How far apart the rays of two cameras to one point are.

Promise: computed in float64 in the order written, whatever the type of the point.
"""

from __future__ import annotations

import numpy as np

from splatseed.kernels.jit import always_inline


@always_inline
def cosine_between(point, first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """Cosine of the angle at a point [3] between rays to cameras at ``first`` and ``second``."""
    dot, first_squared, second_squared = 0.0, 0.0, 0.0
    for axis in range(3):
        a, b = point[axis] - first[axis], point[axis] - second[axis]
        dot += a * b
        first_squared += a * a
        second_squared += b * b
    return dot / np.sqrt(first_squared * second_squared)
