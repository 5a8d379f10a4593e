"""The surface that a cloud forms in an image, on coarse cells, and the points that it hides.

Notation: an image of W x H pixels is divided into ``camera.grid_shape(c)`` equal cells, of c x c
pixels or a little less. The *cell depth* is the lower quartile of the depths (planar z) of a cell's
points; it is infinite without points, and where at least ``MIN_NEARER`` of the eight neighbours
are nearer by more than ``SURFACE``: a surface hides what shows between its points.
Promise: results depend neither on the order of the points nor on the number of threads.

A z-buffer in which any nearer neighbour hides a cell drops 7% (fox) to 97% (treehill) of the points
that their own tracks prove to be visible, because a few points float in front of the cameras; this
one drops 0.3% to 16%.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int64

from splatseed.camera import Camera
from splatseed.frozen import read_only_view
from splatseed.photos._kernels import drop_hidden, find_cells, lower_quartiles, sort_by_cell
from splatseed.photos.visibility import SURFACE, PointsInImage, points_in_image

MIN_NEARER = 5  # nearer ones among a cell's eight neighbours, from which on they hide it


def cell_depths(
    camera: Camera, xyz: Float32[np.ndarray, "N 3"], cell: float
) -> Float32[np.ndarray, "rows cols"]:
    """The depth of each cell of ``cell`` pixels; infinite where it is empty or hidden.

    ``xyz`` is C-contiguous.
    """
    cells, depths = _cells(camera, xyz, cell)
    shape = camera.grid_shape(cell)
    starts, by_cell = sort_by_cell(cells, depths, shape[0] * shape[1])
    quartiles, visible = np.empty(shape, np.float32), np.empty(shape, np.float32)
    lower_quartiles(starts, by_cell, quartiles)
    drop_hidden(quartiles, SURFACE, MIN_NEARER, visible)
    return visible


def cell_counts(
    camera: Camera, xyz: Float32[np.ndarray, "N 3"], cell: float
) -> Int64[np.ndarray, " C"]:
    """How many points lie in each cell, hidden or not, row by row."""
    cells, _ = _cells(camera, xyz, cell)
    rows, cols = camera.grid_shape(cell)
    return np.bincount(cells[cells >= 0], minlength=rows * cols)


def _cells(camera: Camera, xyz: Float32[np.ndarray, "N 3"], cell: float) -> tuple[np.ndarray, ...]:
    """The cell (row by row; -1 outside) and the depth of each point."""
    cells, depths = np.empty(len(xyz), np.int32), np.empty(len(xyz), np.float32)
    grid = camera.cells_from_world(cell), *camera.grid_shape(cell)
    find_cells(read_only_view(xyz), *grid, cells, depths)
    return cells, depths


def visible_points(
    camera: Camera,
    xyz: Float32[np.ndarray, "N 3"],
    cell: float,
    mask: Bool[np.ndarray, "H W"] | None = None,
) -> PointsInImage:
    """The points on the surfaces that they form themselves, at pixels that count.

    A point is hidden if it lies behind its cell's depth by more than ``SURFACE`` of it, or if its
    cell is hidden. ``xyz`` is C-contiguous; a ``mask`` is False at pixels that do not count.
    """
    points = points_in_image(camera, xyz)
    col, row = points.uv.astype(np.int64).T
    depths = cell_depths(camera, xyz, cell)
    rows, cols = depths.shape
    surface = depths[row * rows // camera.height, col * cols // camera.width]
    seen = (points.depth <= surface * (1 + SURFACE)) & np.isfinite(surface)
    if mask is not None:
        seen &= mask[row, col]
    return points.select(seen)
