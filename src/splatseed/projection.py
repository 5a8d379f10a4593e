"""Projection of world points into cameras, and back: the one place that does it, for arrays.

Notation: ``matrix`` [3, 4] maps homogeneous world points to (column z, row z, z).
``Camera.pixels_from_world`` gives pixels (the centre of the first at (0.5, 0.5)),
``Camera.cells_from_world`` cells of a grid over the image. *Depth* is planar z in the world's unit.
*Normalised coordinates* (x, y) stand for the ray (x, y, 1) in camera axes.
Promise: float64, in sums written out in one order, so that ``project`` (NumPy) and
``project_point`` (kernels) agree bit for bit, whatever the number of threads.

From a kernel, import ``project_point``, ``project_block`` (N points, vectorised) and
``cosine_between`` from ``photos._kernels``, and pass them such a matrix. The points that a camera
sees are found by ``photos.visibility``, those that a cloud hides by ``photos.zbuffer``; lens
distortion acts on normalised coordinates (``lens``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64


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


def scaled(
    K: Float64[np.ndarray, "3 3"], x: float, y: float | None = None
) -> Float64[np.ndarray, "3 3"]:
    """K of an image with ``x`` times the columns, and ``y`` (by default ``x``) times the rows."""
    return np.asarray(np.diag([x, x if y is None else y, 1.0]) @ K)


def pixel_centers(rows: int, columns: int) -> Float64[np.ndarray, "rows columns 2"]:
    """(column, row) of the centre of each pixel, or of each cell of a grid."""
    column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return np.stack([column, row], axis=-1)


def normalized(
    K: Float64[np.ndarray, "3 3"], uv: Float[np.ndarray, "*B 2"]
) -> Float64[np.ndarray, "*B 2"]:
    """Normalised coordinates of pixels: (x, y, 1) = K^-1 (u, v, 1)."""
    u, v = np.moveaxis(np.asarray(uv, np.float64), -1, 0)
    y = (v - K[1, 2]) / K[1, 1]
    x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y], axis=-1)


def denormalized(
    K: Float64[np.ndarray, "3 3"], xy: Float64[np.ndarray, "*B 2"]
) -> Float64[np.ndarray, "*B 2"]:
    """Pixels of normalised coordinates: (u, v, 1) = K (x, y, 1)."""
    x, y = np.moveaxis(xy, -1, 0)
    return np.stack([x * K[0, 0] + y * K[0, 1] + K[0, 2], y * K[1, 1] + K[1, 2]], axis=-1)


def in_camera(
    cam_from_world: Float64[np.ndarray, "N 4 4"], xyz: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """World points in camera axes, each in those of its own camera."""
    rotated = np.einsum("nij,nj->ni", cam_from_world[:, :3, :3], xyz)
    return np.asarray(rotated + cam_from_world[:, :3, 3])


def pixel_jacobians(
    focals: Float64[np.ndarray, "N 2"],
    cam_from_world: Float64[np.ndarray, "N 4 4"],
    xyz: Float64[np.ndarray, "N 3"],
) -> Float64[np.ndarray, "N 2 3"]:
    """Derivatives d (u, v) / d X of points in the axes of their own cameras (``in_camera``).

    u = f x / z + c gives du/dX = (f / z) (r_x - (x / z) r_z), r_x and r_z rows of the rotation.
    """
    slope = xyz[:, :2] / xyz[:, 2:]
    across = cam_from_world[:, :2, :3] - slope[:, :, None] * cam_from_world[:, None, 2, :3]
    return np.asarray((focals / xyz[:, 2:])[:, :, None] * across)


def camera_centers(
    cam_from_world: Sequence[Float[np.ndarray, "4 4"]] | Float[np.ndarray, "V 4 4"],
) -> Float64[np.ndarray, "V 3"]:
    """World positions of cameras with these poses: -R^T t."""
    poses = np.array(cam_from_world, np.float64).reshape(-1, 4, 4)
    return np.asarray(-(poses[:, :3, :3] * poses[:, :3, 3:]).sum(axis=1))
