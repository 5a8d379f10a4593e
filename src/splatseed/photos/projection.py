"""Projection of world points into a camera: the one place that does it, for arrays and kernels.

Notation: ``matrix`` [3, 4] maps homogeneous world points to (column z, row z, z). That of
``pixels_from_world`` gives pixels (the centre of the first at (0.5, 0.5)), that of
``cells_from_world`` cells of a grid over the image. *Depth* is planar z in the world's unit.
Promise: float64, in sums written out in one order, so that ``project`` (NumPy) and
``project_point`` (kernels) agree bit for bit, whatever the number of threads.

From a kernel, import ``project_point``, ``project_block`` (N points, vectorised) and
``cosine_between`` from ``photos._kernels``, and pass them such a matrix. The points that a camera
sees are found by ``photos.visibility``, those that a cloud hides by ``photos.zbuffer``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from splatseed.camera import Camera


class Projected(NamedTuple):
    """N points in an image or grid."""

    column: Float64[np.ndarray, " N"]
    row: Float64[np.ndarray, " N"]
    depth: Float64[np.ndarray, " N"]


def project(matrix: Float64[np.ndarray, "3 4"], xyz: Float[np.ndarray, "N 3"]) -> Projected:
    """Column, row and planar depth of world points.

    Behind the camera the depth is negative; at depth 0 column and row are not finite. For many
    calls with the same points pass them as ``np.asfortranarray(xyz, np.float64)``, which is not
    copied.
    """
    x, y, z = np.asfortranarray(xyz, np.float64).T
    across, down, depth = (m[0] * x + m[1] * y + m[2] * z + m[3] for m in matrix)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1.0 / depth
        return Projected(across * inverse, down * inverse, depth)


def pixels_from_world(camera: Camera) -> Float64[np.ndarray, "3 4"]:
    """The matrix to pixels: K cam_from_world."""
    return np.asarray(camera.K @ camera.cam_from_world[:3])


def grid_shape(camera: Camera, cell: float) -> tuple[int, int]:
    """Rows and columns of the cells, at most ``cell`` pixels wide, that an image is divided into.

    All cells are equal: a little smaller than ``cell`` where it does not divide the size.
    """
    return math.ceil(camera.height / cell), math.ceil(camera.width / cell)


def cells_from_world(camera: Camera, cell: float) -> Float64[np.ndarray, "3 4"]:
    """The matrix to cells: cell (i, j) spans rows i to i + 1 and columns j to j + 1."""
    rows, cols = grid_shape(camera, cell)
    cells_from_pixels = np.diag([cols / camera.width, rows / camera.height, 1.0])
    return np.asarray(cells_from_pixels @ camera.K @ camera.cam_from_world[:3])
