"""Fuse the maps of all views to one seed per piece of surface.

Each view is divided into square cells. A pixel becomes a seed unless its cell, in its own view or
in one that confirms it, already has a seed at that depth. Pixels come view by view, the most
confident first. Cells may have several sizes, the *levels* (see ``detail``): each pixel then has
the level of its surroundings. Where cells are smaller than a pixel of the map, it has several
*places*, all on its plane.

Promise: seeds lie on confirmed depths only; the same maps give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from splatseed.depth.stereo._kernels.agreement import occupy_cells
from splatseed.depth.stereo.maps import StereoResult, block_means
from splatseed.depth.stereo.matching import other_from_view
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent

SAME_DEPTH = 0.03
"""Relative difference of depth up to which two seeds in a cell count as one."""


@dataclass(frozen=True, eq=False)
class Places:
    """Places in a view that become seeds, on the planes of its map."""

    pixels: Int32[np.ndarray, " M"]  # of the map, row * w + column
    place: UInt8[np.ndarray, " M"]  # within the pixel, row by row
    sides: Float64[np.ndarray, " M"]  # of their cells, in pixels of the view
    split: int  # places along a row and a column of a pixel

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class CellGrids:
    """The cells of all views at all levels, and the seeds in them."""

    cells: Float64[np.ndarray, " L"]  # side of a cell at each level, in pixels
    offsets: Int64[np.ndarray, "V L"]  # start of each view's cells at each level
    columns: Int64[np.ndarray, "V L"]  # cells in a row
    limits: Int64[np.ndarray, "V 2"]  # width and height of each view
    occupied: Float32[np.ndarray, " C"]  # inverse depth of the seed in each cell, 0 without

    @classmethod
    def of(cls, views: Sequence[View], cells: Sequence[float]) -> CellGrids:
        """Cells without seeds."""
        sides = np.array(cells, np.float64)
        columns, rows = (
            (np.array([getattr(view, side) for view in views])[:, None] / sides).astype(int) + 1
            for side in ("width", "height")
        )
        starts = np.cumsum([0, *(rows * columns).ravel()])
        occupied = np.zeros(starts[-1], np.float32)
        limits = np.array([(view.width, view.height) for view in views])
        return cls(sides, starts[:-1].reshape(rows.shape), columns, limits, occupied)

    def occupy(self, i: int, uv: Float64[np.ndarray, "M 2"], z: Float64[np.ndarray, " M"]) -> None:
        """Occupy the cells of view i, at all levels, at these pixels and depths."""
        for level, side in enumerate(self.cells):
            column, row = (uv / side).astype(np.int64).T
            self.occupied[self.offsets[i, level] + row * self.columns[i, level] + column] = 1.0 / z

    def choose(
        self,
        stereo: StereoResult,
        i: int,
        order: Int32[np.ndarray, " P"],
        levels: UInt8[np.ndarray, "h w"],
        split: int = 1,
    ) -> Places:
        """Choose the places in view i that become seeds; occupies their cells in all views.

        Args:
            stereo: The maps.
            i: The view.
            order: Its pixels by priority.
            levels: Of each pixel.
            split: Places along a row and a column of a pixel.
        """
        others = stereo.sources[i]
        matrices: Float64[np.ndarray, "K 3 4"] = np.zeros((len(others), 3, 4))
        for k, j in enumerate(others.tolist()):
            if j >= 0:
                matrices[k] = other_from_view(stereo.views[i], stereo.views[j])
        chosen = np.zeros((len(order), split * split), np.bool_)
        occupy_cells(
            order, levels, stereo.planes[i], stereo.agreeing[i], i, others, matrices,
            stereo.settings.grid, split, self.limits, self.cells, SAME_DEPTH, self.occupied,
            self.offsets, self.columns, chosen,
        )  # fmt: skip
        at, place = np.nonzero(chosen)
        pixels = order[at]
        return Places(pixels, place.astype(np.uint8), self.cells[levels.ravel()[pixels]], split)


def fuse(stereo: StereoResult, cell: float, progress: Progress = silent) -> PointCloud:
    """Choose seeds from confirmed pixels, about ``cell`` pixels apart in the photographs.

    Args:
        stereo: The result of stereo.
        cell: Side of a cell in pixels of the views; not below the grid of the maps.
        progress: Called with the stage and the fraction done.

    Returns:
        World positions view by view, the mean colour of the map's pixel, normals towards the view,
        as sizes the side of a cell at that depth, and confidence.
    """
    grids = CellGrids.of(stereo.views, [max(float(cell), float(stereo.settings.grid))])
    parts = []
    for i in range(len(stereo.views)):
        levels = np.zeros(stereo.costs[i].shape, np.uint8)
        chosen = grids.choose(stereo, i, by_confidence(stereo, i), levels)
        parts.append(make_seeds(stereo, i, chosen))
        progress("fuse depths", (i + 1) / len(stereo.views))
    return PointCloud.concatenate(*parts)


def by_confidence(stereo: StereoResult, i: int) -> Int32[np.ndarray, " P"]:
    """Confirmed pixels of view i, row * w + column, the most confident first."""
    confidence = stereo.confidence(i).ravel()
    # Pixels at 0 are not confirmed.
    order = np.argsort(-confidence, kind="stable")[: np.count_nonzero(confidence)]
    return order.astype(np.int32)


def make_seeds(stereo: StereoResult, i: int, places: Places) -> PointCloud:
    """Seeds at places of view i."""
    view, grid, split = stereo.views[i], stereo.settings.grid, places.split
    width = stereo.costs[i].shape[1]
    row, column = places.pixels // width, places.pixels % width
    part = np.stack([places.place % split, places.place // split], axis=1)
    w, gx, gy = stereo.planes[i][:, row, column].astype(np.float64)
    across, down = (((part + 0.5) / split - 0.5) * grid).T
    # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
    z = 1.0 / (w + gx * across + gy * down)
    uv = (np.stack([column, row], axis=1) + 0.5) * grid + np.stack([across, down], axis=1)
    # n' R = (R' n)': from camera axes to the world's.
    normals = stereo.normals(i)[row, column] @ view.cam_from_world[:3, :3]
    column, row = (np.stack([column, row], axis=1) * split + part).T
    return PointCloud(
        view.camera.unproject(uv, z).astype(np.float32),
        block_means(view.photograph, grid // split)[row, column],
        normals=normals.astype(np.float32),
        sizes=(places.sides * z / view.K[0, 0]).astype(np.float32),
        confidence=stereo.confidence(i)[places.pixels // width, places.pixels % width],
    )
