"""Cover: a seed in every part of every photograph that no point covers.

Notation: views are divided into the cells of ``photos.zbuffer``; a cell is *covered* if it holds a
point and its neighbours do not hide it, so that its depth is finite; else it is *empty*. Views are
taken in random order, each with the seeds of the views before. An empty cell gets one seed on the
ray through its centre. Its depth is a guess from covered cells of the same view: in each of eight
sectors of 45 degrees the nearest one, up to ``2 r + 1`` cells away, where r is the distance of the
nearest of all. Another view *contradicts* a seed that lies in front of the view's covered cell,
nearer by more than ``SURFACE``: it sees through the seed. The guess is the median of the sectors'
depths, weighted by ``1 / ((1 + contradictions) distance^2)``. In a view without covered cells it is
the median depth of all views.
Promise: confidence is low, at most ``MAX_CONFIDENCE``; the same seed gives the same bytes on any
number of cores, as views are processed one after another.

benchmarks/tried.md says how the rule was chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatseed.errors import ParameterError, PointCloudError
from splatseed.methods import source_code
from splatseed.photos.view import View
from splatseed.photos.visibility import SURFACE
from splatseed.photos.zbuffer import cell_depths
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.seeding._kernels.cover import guess_cell_depths, lift_cells, mean_colors

CHECKED_VIEWS = 12  # other views that may contradict a seed
MIN_CHECK_CELL = 8  # minimum side of these views' cells, in pixels
MAX_CONFIDENCE, MIN_CONFIDENCE = 0.3, 0.1
"""Confidence of a seed beside a covered cell, and of one far from all."""


def covered_share(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    cell: float = 8,
    progress: Progress = silent,
) -> float:
    """Return the mean over views of the fraction of cells, ``cell`` pixels wide, that are covered.

    Views need no pixels.
    """
    return float(np.mean([cells.mean() for cells in covered_cells(views, xyz, cell, progress)]))


def covered_cells(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    cell: float = 8,
    progress: Progress = silent,
) -> tuple[Bool[np.ndarray, "rows cols"], ...]:
    """Return which cells of each view are covered; arguments as of ``covered_share``."""
    xyz = check_points(views, xyz, cell)
    depths = cell_depths_of_views(views, xyz, cell, progress, "find uncovered cells")
    return tuple(np.isfinite(cells) for cells in depths)


def cell_depths_of_views(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    cell: float,
    progress: Progress,
    stage: str,
) -> list[Float32[np.ndarray, "rows cols"]]:
    """Compute ``cell_depths`` of each view, on all threads."""
    maps = [np.empty((0, 0), np.float32)] * len(views)

    def work(start: int, _stop: int) -> None:
        maps[start] = cell_depths(views[start].camera, xyz, cell)

    in_threads(work, len(views), 1, stage, progress)
    return maps


def check_points(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], cell: float
) -> Float32[np.ndarray, "N 3"]:
    """Check views, cell and points; return the points as kernels need them."""
    if not views:
        raise ParameterError("at least one view", found="none", fix="Pass a scene with images.")
    if not (np.isfinite(cell) and cell >= 1):
        raise ParameterError("a cell of at least 1 pixel", found=f"{cell}", fix="Choose 4 to 16.")
    return kernel_points(xyz)


def kernel_points(xyz: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Return points as kernels need them: float32, contiguous."""
    xyz = np.asarray(xyz)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise PointCloudError(
            "xyz of shape [N, 3]", found=f"{list(xyz.shape)}", fix="Pass one row x, y, z per point."
        )
    return np.ascontiguousarray(xyz, np.float32)


@dataclass(frozen=True, eq=False)
class ReferenceDepths:
    """The cell depths of the initial points in each of V views."""

    cells_from_world: Float64[np.ndarray, "V 3 4"]
    shapes: Int64[np.ndarray, "V 2"]  # rows and columns of each view
    starts: Int64[np.ndarray, " V"]  # of each view in ``depths``
    depths: Float32[np.ndarray, " C"]  # of all cells, row by row; infinite where not covered


def reference_depths(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], cell: float, progress: Progress
) -> ReferenceDepths:
    """Compute the depths of the points in each view, on cells of ``cell`` pixels."""
    maps = cell_depths_of_views(views, xyz, cell, progress, "find uncovered cells")
    sizes = np.array([depths.size for depths in maps])
    return ReferenceDepths(
        np.stack([view.camera.cells_from_world(cell) for view in views]),
        np.array([depths.shape for depths in maps]),
        np.cumsum(sizes) - sizes,
        np.concatenate([depths.ravel() for depths in maps]),
    )


def world_from_cells(view: View, cell: float) -> Float64[np.ndarray, "3 4"]:
    """Return the matrix from (column depth, row depth, depth, 1), in cells, to the world."""
    forward = np.vstack([view.camera.cells_from_world(cell), [0.0, 0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(forward)[:3])


def guess_depths(
    depths: Float32[np.ndarray, "rows cols"],
    empty: Int64[np.ndarray, " M"],
    world_from_cells: Float64[np.ndarray, "3 4"],
    reference: ReferenceDepths,
    checked: Int64[np.ndarray, " K"],
) -> tuple[Float32[np.ndarray, " M"], Float32[np.ndarray, " M"]]:
    """Guess the depths of a view's empty cells.

    Args:
        depths: The view's cell depths, at least one of them finite.
        empty: The cells, as row * cols + column.
        world_from_cells: As the function of that name returns.
        reference: The depths of all views.
        checked: The views that may contradict.

    Returns:
        The depths, and the distances to the nearest covered cells, in cells.
    """
    guesses, distances = np.empty(len(empty), np.float32), np.empty(len(empty), np.float32)
    guess_cell_depths(
        depths, empty, world_from_cells, reference.cells_from_world[checked],
        reference.shapes[checked], reference.starts[checked], reference.depths, SURFACE,
        guesses, distances,
    )  # fmt: skip
    return guesses, distances


Mask = Bool[np.ndarray, "H W"]


def cover(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    *,
    cell: float = 8,
    rng: np.random.Generator,
    masks: Sequence[Mask | None] | None = None,
    progress: Progress = silent,
) -> PointCloud:
    """Seed every empty cell of every view.

    Args:
        views: Photographs with their pixels.
        xyz: The points; those that are not finite are in no cell.
        cell: Side of a cell, in pixels.
        rng: Draws the order of the views, and those that may contradict.
        masks: For each view the pixels that count, None for all; a cell needs half of its pixels.
        progress: Called with the stage and the fraction done.

    Returns:
        Seeds in the order in which the views were taken, with the mean colour of the cell, as sizes
        the side of the cell at that depth, and confidence: 0.3 beside a covered cell, falling to
        0.1.

    Raises:
        ParameterError: There is no view, one has no pixels, ``cell`` is below 1, or a mask has
            another size.
        PointCloudError: ``xyz`` is not of shape [N, 3], or no point lies in any view.
    """
    xyz = check_points(views, xyz, cell)
    masks = _check_pixels(views, masks)
    reference = reference_depths(views, xyz, max(cell, MIN_CHECK_CELL), progress)
    typical = _typical_depth(reference, len(xyz))
    cloud = GrowableArray(xyz)
    parts = []
    for v in rng.permutation(len(views)):
        # Drawn for every view, empty cells or not: one view's gaps do not change the next's draw.
        checked = _draw_others(int(v), len(views), rng)
        depths = cell_depths(views[v].camera, cloud.values, cell)
        empty = np.flatnonzero(np.isinf(depths))
        if len(empty) < depths.size:
            lift = world_from_cells(views[v], cell)
            guess = guess_depths(depths, empty, lift, reference, checked)
        else:
            guess = np.full(len(empty), typical), np.full(len(empty), np.inf, np.float32)
        seeds = make_seeds(views[v], cell, empty, guess, masks[v])
        cloud.append(seeds.xyz)
        parts.append(seeds)
        progress("cover", len(parts) / len(views))
    return PointCloud.concatenate(*parts).with_source(source_code("cover"))


def _draw_others(v: int, num: int, rng: np.random.Generator) -> Int64[np.ndarray, " K"]:
    others = rng.choice(num - 1, min(CHECKED_VIEWS, num - 1), replace=False)
    # Numbers from v on move up by one: v itself is left out.
    return others + (others >= v)


def _check_pixels(
    views: Sequence[View], masks: Sequence[Mask | None] | None
) -> Sequence[Mask | None]:
    masks = [None] * len(views) if masks is None else masks
    if len(masks) != len(views):
        raise ParameterError(
            f"a mask or None for each of {len(views)} views", found=f"{len(masks)}", fix="Add None."
        )
    for view, mask in zip(views, masks, strict=True):
        _check_size("pixels", view, view.photograph.shape[:2])
        if mask is not None:
            _check_size("a mask", view, np.shape(mask))
    return masks


def _check_size(what: str, view: View, size: tuple[int, ...]) -> None:
    if size != (view.height, view.width):
        raise ParameterError(
            f"{what} of {view.width} x {view.height} for {view.name}",
            found=" x ".join(map(str, reversed(size))),
            fix="Load the view with its photograph, and its mask at that size.",
        )


def _typical_depth(reference: ReferenceDepths, num: int) -> np.float32:
    """Return the median depth of all covered cells, for views without any."""
    depths = reference.depths[np.isfinite(reference.depths)]
    if not len(depths):
        raise PointCloudError(
            "a point that lies in one of the views",
            found=f"none of {num}",
            fix="Check that points and cameras belong to the same scene.",
        )
    return np.float32(np.median(depths))


class GrowableArray:
    """An array of points with amortised appending."""

    def __init__(self, values: Float32[np.ndarray, "N 3"]) -> None:
        self._buffer = values
        self._num = len(values)

    @property
    def values(self) -> Float32[np.ndarray, "N 3"]:
        """The points so far, without a copy."""
        return self._buffer[: self._num]

    def append(self, more: Float32[np.ndarray, "M 3"]) -> None:
        """Add points at the end."""
        num = self._num + len(more)
        if num > len(self._buffer):
            # Doubled, so that all copies together are linear in the number of points.
            buffer = np.empty((2 * num, 3), np.float32)
            buffer[: self._num] = self.values
            self._buffer = buffer
        self._buffer[self._num : num] = more
        self._num = num


def make_seeds(
    view: View,
    cell: float,
    empty: Int64[np.ndarray, " M"],
    guess: tuple[Float32[np.ndarray, " M"], Float32[np.ndarray, " M"]],
    mask: Mask | None,
) -> PointCloud:
    """Place seeds in empty cells at given depths, except where too few pixels count.

    ``guess`` are the depths and the distances to the nearest covered cells, in cells.
    """
    depths, distances = guess
    shape = view.camera.grid_shape(cell)
    used = np.ones((1, 1), np.bool_) if mask is None else np.asarray(mask, np.bool_)
    rgb, usable = np.empty((len(empty), 3), np.uint8), np.empty(len(empty), np.bool_)
    mean_colors(view.photograph, used, shape, empty, rgb, usable)
    xyz = np.empty((len(empty), 3), np.float32)
    lift_cells(world_from_cells(view, cell), shape[1], empty, depths, xyz)
    usable &= np.isfinite(xyz).all(axis=1)
    sides = depths * np.float32(_side_at_one(view, shape))
    # The distance is 1 beside a covered cell.
    confidence = np.maximum(np.float32(MAX_CONFIDENCE) / distances, np.float32(MIN_CONFIDENCE))
    return PointCloud(xyz[usable], rgb[usable], sizes=sides[usable], confidence=confidence[usable])


def _side_at_one(view: View, shape: tuple[int, ...]) -> float:
    """Return the side of a cell at depth 1: the square root of its area."""
    width, height = view.width / shape[1] / view.K[0, 0], view.height / shape[0] / view.K[1, 1]
    return float(np.sqrt(abs(width * height)))
