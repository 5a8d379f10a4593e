"""From a point of the world to a place on a view's grid, and the angle between rays to it.

Notation: ``matrix`` [3, 4] maps homogeneous world points to (column z, row z, z). With K @
``cam_from_world[:3]`` columns and rows are pixel coordinates, the centre of the first at (0.5,
0.5); a coarser grid, or one whose points lie at whole numbers, has its own first matrix instead of
K. Promise: computed in float64 in the order written, whatever the type of the point.
"""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import always_inline, inline


@inline
def place(point, matrix):  # type: ignore[no-untyped-def]  # Numba's types
    """Column, row and planar depth of a world point [3], as floats.

    The point is behind the camera if the depth is negative; at 0 column and row are not finite.
    """
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    # (column z, row z, z) = matrix (x, y, z, 1)
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    inverse = 1.0 / depth
    column = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) * inverse
    row = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) * inverse
    return column, row, depth


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
