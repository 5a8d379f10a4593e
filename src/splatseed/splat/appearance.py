"""The colour of each seed in the photographs, and its dependence on the viewing direction.

Notation: seen along the unit direction d from a camera, a Gaussian has the colour c(d) = 1/2 +
sum_k y_k(d) h_k with the real spherical harmonics y up to degree 1, in 3DGS's order and signs: y =
(C0, -C1 d_y, C1 d_z, -C1 d_x). Promise: the same bytes whatever the number of threads; a seed that
no view sees keeps its colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

from splatseed.pointcloud import PointCloud
from splatseed.seeding.coverage import NEARER, cell_depths, grid_of
from splatseed.splat.gaussians import SH_C0
from splatseed.views.view import View

SH_C1 = 0.4886025119029199
"""Constant of degree 1, sqrt(3 / (4 pi))."""
NUM_FITTED = 4
"""Number of harmonics up to degree 1."""
OWN = 0.3
"""Weight of a seed's own colour, in photographs."""
EVEN = 1.0
"""Weight of the prior against view dependence, in photographs: few views do not determine it."""
CELL = 4.0
"""Side in pixels of the cells within which seeds occlude each other."""
MOST_PROJECTIONS = 50_000_000
"""Limit on seeds times views: beyond it, an even subset of the views is used."""
LEAST_VIEWS = 16
"""But never fewer views than this."""


class _Shown(NamedTuple):
    """The M seeds that a view sees."""

    seed_idx: Int64[np.ndarray, " M"]
    column: Int64[np.ndarray, " M"]
    row: Int64[np.ndarray, " M"]


def fit_harmonics(seeds: PointCloud, views: Sequence[View]) -> Float32[np.ndarray, "N 4 3"]:
    """Coefficients h of each seed: ridge regression over the views that see it.

    With the colours p_v seen by V views along directions d_v, and the seed's own colour p, it
    solves min over h of sum_v |1/2 + y(d_v) h - p_v|^2 + OWN |1/2 + C0 h_0 - p|^2 + EVEN |C1
    h_1..3|^2, a ridge regression of four unknowns per colour channel.

    Args:
        seeds: N points and their colours.
        views: Photographs with their cameras, in the points' frame.
    """
    xyz = np.ascontiguousarray(seeds.xyz, np.float32)
    own = seeds.rgb / 255.0 - 0.5
    normal, right = (
        np.zeros((len(xyz), NUM_FITTED, NUM_FITTED)),
        np.zeros((len(xyz), NUM_FITTED, 3)),
    )
    normal += np.diag([OWN * SH_C0**2, *[EVEN * SH_C1**2] * 3])
    # Normal equations; OWN and EVEN make them regular even for a seed that no view sees.
    right[:, 0] += OWN * SH_C0 * own
    for view in _asked(views, len(xyz)):
        shown = _shown(xyz, view)
        basis = _harmonics(xyz[shown.seed_idx], view)
        normal[shown.seed_idx] += basis[:, :, None] * basis[:, None, :]
        colors = _colors(view.photograph, shown) - 0.5
        right[shown.seed_idx] += basis[:, :, None] * colors[:, None, :]
    return np.linalg.solve(normal, right).astype(np.float32)


def _asked(views: Sequence[View], count: int) -> list[View]:
    most = max(LEAST_VIEWS, MOST_PROJECTIONS // max(1, count))
    chosen = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
    return [views[i] for i in np.unique(chosen)]


def _shown(xyz: Float32[np.ndarray, "N 3"], view: View) -> _Shown:
    """The seeds in the photograph that no seed in the same or a neighbouring cell occludes."""
    x, y, depth = _place(xyz, view)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = x / depth, y / depth
    inside = (depth > 0) & (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
    index = np.flatnonzero(inside)
    column, row = column[index].astype(np.int64), row[index].astype(np.int64)
    (rows, cols), depths = grid_of(view, CELL), cell_depths(view, xyz, CELL)
    nearest = depths[row * rows // view.height, column * cols // view.width]
    # A tenth behind the cell's depth still counts as its surface.
    seen = depth[index] <= nearest * (1 + NEARER)
    seen &= np.isfinite(nearest)
    return _Shown(index[seen], column[seen], row[seen])


def _place(xyz: Float32[np.ndarray, "N 3"], view: View) -> Float64[np.ndarray, "3 N"]:
    """Pixels times depth, and depth, in written-out sums: BLAS's order varies with threads."""
    matrix, columns = view.K @ view.cam_from_world[:3], xyz.T.astype(np.float64)
    return np.stack(
        [row[0] * columns[0] + row[1] * columns[1] + row[2] * columns[2] + row[3] for row in matrix]
    )


def _harmonics(xyz: Float[np.ndarray, "M 3"], view: View) -> Float64[np.ndarray, "M 4"]:
    """y(d) of the directions from the camera."""
    center = -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
    sight = xyz.astype(np.float64) - center
    d = sight / np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-12)
    ones = np.full(len(d), SH_C0)
    return np.stack([ones, -SH_C1 * d[:, 1], SH_C1 * d[:, 2], -SH_C1 * d[:, 0]], axis=1)


def _colors(image: UInt8[np.ndarray, "H W 3"], shown: _Shown) -> Float64[np.ndarray, "M 3"]:
    """Mean colours of the 3 x 3 pixels around, 0 to 1; border pixels are repeated."""
    height, width = image.shape[:2]
    total = np.zeros((len(shown.seed_idx), 3))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            rows = np.clip(shown.row + down, 0, height - 1)
            total += image[rows, np.clip(shown.column + right, 0, width - 1)]
    return total / (9 * 255.0)
