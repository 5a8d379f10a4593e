"""Cover: a seed in every part of every photograph that no point covers.

Notation: cells, their depths and *covered* are defined in ``coverage``. Views are taken in random
order, each seeing the seeds of the views before. An empty cell gets one seed on the ray through its
centre. For its depth, in each of eight sectors of 45 degrees around it the nearest covered cell is
consulted, up to ``2 r + 1`` cells away, where r is the distance of the first one. A seed at that
depth is *contradicted* by another view if it lies in front of a covered cell there, nearer by more
than ``SURFACE``: that view looks through it. The guess is the median of the sectors' depths,
weighted by ``1 / ((1 + contradictions) distance^2)``. If a view has no covered cell, the median
depth of all views is used.
Promise: a cover seed is a guess and says so by its confidence; its depth is one of the view's; the
same seed gives the same bytes on any number of cores: views are processed one after another.

benchmarks/seeds/README.md says how the rule was chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from splatseed.errors import ParameterError, PointCloudError
from splatseed.photos._kernels import project_point
from splatseed.photos.projection import cells_from_world, grid_shape
from splatseed.photos.view import View
from splatseed.photos.visibility import SURFACE
from splatseed.photos.zbuffer import cell_depths
from splatseed.progress import Progress, silent
from splatseed.runtime.jit import inline
from splatseed.seeding.coverage import check_points, depths_of_views

SECTORS = 8


@dataclass(frozen=True, eq=False)
class Witnesses:
    """The depths at which each of V views sees the initial points."""

    grid_from_world: Float64[np.ndarray, "V 3 4"]  # to columns and rows of cells, and depth
    shapes: Int64[np.ndarray, "V 2"]  # rows and columns of each view
    starts: Int64[np.ndarray, " V"]  # where each view's depths begin
    depths: Float32[np.ndarray, " C"]  # of all cells, row by row; infinite where not covered


def depth_maps_of_views(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], cell: float, progress: Progress
) -> Witnesses:
    """The depths at which each view sees the points, on cells of ``cell`` pixels."""
    maps = depths_of_views(views, xyz, cell, progress, "look for uncovered cells")
    sizes = np.array([depths.size for depths in maps])
    return Witnesses(
        np.stack([cells_from_world(view.camera, cell) for view in views]),
        np.array([depths.shape for depths in maps]),
        np.cumsum(sizes) - sizes,
        np.concatenate([depths.ravel() for depths in maps]),
    )


def world_from_grid(view: View, cell: float) -> Float64[np.ndarray, "3 4"]:
    """(column depth, row depth, depth, 1) to the world, columns and rows in cells."""
    forward = np.vstack([cells_from_world(view.camera, cell), [0.0, 0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(forward)[:3])


def guess_depths(
    depths: Float32[np.ndarray, "rows cols"],
    empty: Int64[np.ndarray, " M"],
    back: Float64[np.ndarray, "3 4"],
    witnesses: Witnesses,
    asked: Int64[np.ndarray, " K"],
) -> tuple[Float32[np.ndarray, " M"], Float32[np.ndarray, " M"]]:
    """Depths of empty cells, given as row * cols + column, and distances to covered ones, in cells.

    At least one is covered; ``back`` is the view's ``world_from_grid``, and ``asked`` views may
    contradict.
    """
    guesses, reach = np.empty(len(empty), np.float32), np.empty(len(empty), np.float32)
    _guess(
        depths, empty, back, witnesses.grid_from_world[asked], witnesses.shapes[asked],
        witnesses.starts[asked], witnesses.depths, guesses, reach,
    )  # fmt: skip
    return guesses, reach


@inline
def _guess(depths, empty, back, matrices, shapes, starts, seen, guesses, reach):  # type: ignore[no-untyped-def]  # Numba's types
    nearest, depth_of = np.empty(SECTORS), np.empty(SECTORS, np.float32)
    weights, point = np.empty(SECTORS), np.empty(3)
    for k in range(len(empty)):
        i, j = divmod(empty[k], depths.shape[1])
        _look_around(depths, i, j, nearest, depth_of)
        for s in range(SECTORS):
            weights[s] = 0.0
            if nearest[s] < np.inf:
                lift(back, i, j, depth_of[s], point)
                against = _contradictions(point, matrices, shapes, starts, seen)
                # 1 / ((1 + contradictions) distance^2)
                weights[s] = 1.0 / ((1.0 + against) * nearest[s])
        guesses[k] = _weighted_median(depth_of, weights)
        reach[k] = np.sqrt(nearest.min())


@inline
def lift(m, i, j, depth, point):  # type: ignore[no-untyped-def]  # Numba's types
    """The point at a depth on the ray through the centre of cell (i, j)."""
    z = np.float64(depth)
    x, y = (j + 0.5) * z, (i + 0.5) * z
    for axis in range(3):
        # X = A z (j + 1/2, i + 1/2, 1) + b
        point[axis] = m[axis, 0] * x + m[axis, 1] * y + m[axis, 2] * z + m[axis, 3]


@inline
def _contradictions(point, matrices, shapes, starts, seen):  # type: ignore[no-untyped-def]  # Numba's types
    """How many views look through a point."""
    count = 0
    for v in range(len(matrices)):
        column, row, depth = project_point(point, matrices[v])
        if depth > 0.0:
            rows, cols = shapes[v]
            if 0.0 <= column < cols and 0.0 <= row < rows:
                there = seen[starts[v] + int(row) * cols + int(column)]
                # In front of a covered cell by more than SURFACE: that view sees past it.
                count += there < np.inf and depth < there * (1.0 - SURFACE)
    return count


@inline
def _look_around(depths, i, j, nearest, depth_of):  # type: ignore[no-untyped-def]  # Numba's types
    """The nearest covered cell of each sector, by squared distance; of equals, ring by ring."""
    for s in range(SECTORS):
        nearest[s] = depth_of[s] = np.inf
    rows, cols = depths.shape
    last = max(i, rows - 1 - i, j, cols - 1 - j)
    ring, seen = 1, False
    while ring <= last:
        for a in range(max(i - ring, 0), min(i + ring + 1, rows)):
            # The first and last row of a ring are whole, of the others only both ends belong to it.
            step = 1 if abs(a - i) == ring else 2 * ring
            for b in range(j - ring, j + ring + 1, step):
                if 0 <= b < cols and depths[a, b] < np.inf:
                    if not seen:
                        # The first covered cell, r = ring away, bounds the search to 2 r + 1.
                        seen, last = True, min(last, 2 * ring + 1)
                    sector, square = _sector(a - i, b - j), (a - i) ** 2 + (b - j) ** 2
                    if square < nearest[sector]:
                        nearest[sector], depth_of[sector] = square, depths[a, b]
        ring += 1


@inline
def _sector(dy, dx):  # type: ignore[no-untyped-def]  # Numba's types
    """The sector of 45 degrees, each including one of its borders; dy and dx are not both 0."""
    if dx > 0 and dy >= 0:
        quarter, u, v = 0, dx, dy
    elif dy > 0:
        quarter, u, v = 1, dy, -dx
    elif dx < 0:
        quarter, u, v = 2, -dx, -dy
    else:
        quarter, u, v = 3, -dy, dx
    return 2 * quarter + (v >= u)


@inline
def _weighted_median(values, weights):  # type: ignore[no-untyped-def]  # Numba's types
    """The smallest value such that it and the values below it hold half of the weight."""
    order = np.argsort(values)
    half = 0.0
    for k in order:
        half += 0.5 * weights[k]
    below = 0.0
    for k in order:
        below += weights[k]
        if below >= half:
            return values[k]
    return values[order[0]]  # never: half of a sum in the same order is no more than the sum


WITNESSES = 12  # other views that are asked whether they look through a seed
WITNESS_CELL = 8  # smallest cell of these views, in pixels
MOST_CONFIDENT, LEAST_CONFIDENT = 0.3, 0.1
"""Confidence of a seed beside a covered cell, and of one far from all."""

Mask = Bool[np.ndarray, "H W"]


@dataclass(frozen=True, eq=False)
class CoverSeeds:
    """Seeds in cells that no point covered, in the order in which the views were taken."""

    xyz: Float32[np.ndarray, "M 3"]  # world
    rgb: UInt8[np.ndarray, "M 3"]  # mean of the cell
    view: Int32[np.ndarray, " M"]  # the view each was made for
    size: Float32[np.ndarray, " M"]  # side of the cell at the seed's depth, scene units
    confidence: Float32[np.ndarray, " M"]  # 0.3 beside a covered cell, falling to 0.1

    def __len__(self) -> int:
        return len(self.xyz)

    @staticmethod
    def concatenate(parts: Sequence[CoverSeeds]) -> CoverSeeds:
        """The seeds of the parts, one after another."""
        names = [field.name for field in fields(CoverSeeds)]
        return CoverSeeds(*(np.concatenate([getattr(part, n) for part in parts]) for n in names))


def cover(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    *,
    cell: float = 8,
    rng: np.random.Generator,
    masks: Sequence[Mask | None] | None = None,
    progress: Progress = silent,
) -> CoverSeeds:
    """A seed in every cell, ``cell`` pixels wide, of every view that no point covers.

    Masks tell which pixels of each view count, None: all; a cell needs half of its pixels. Points
    that are not finite are in no cell. ``rng`` draws the order of the views.

    Raises:
        ParameterError: There is no view, one has no pixels, ``cell`` is below 1, or masks misfit.
        PointCloudError: ``xyz`` is not of shape [N, 3], or no point lies in any view.
    """
    xyz = check_points(views, xyz, cell)
    masks = _check_pixels(views, masks)
    witnesses = depth_maps_of_views(views, xyz, max(cell, WITNESS_CELL), progress)
    typical = _typical_depth(witnesses, len(xyz))
    cloud = _Growing(xyz)
    parts = []
    for v in rng.permutation(len(views)):
        # Drawn for every view, empty cells or not: one view's gaps do not change the next's draw.
        asked = _draw_others(int(v), len(views), rng)
        depths = cell_depths(views[v].camera, cloud.xyz, cell)
        empty = np.flatnonzero(np.isinf(depths))
        if len(empty) < depths.size:
            guess = guess_depths(depths, empty, world_from_grid(views[v], cell), witnesses, asked)
        else:
            guess = np.full(len(empty), typical), np.full(len(empty), np.inf, np.float32)
        seeds = _make_seeds(views[v], int(v), cell, empty, guess, masks[v])
        cloud.add(seeds.xyz)
        parts.append(seeds)
        progress("cover", len(parts) / len(views))
    return CoverSeeds.concatenate(parts)


def _draw_others(v: int, num: int, rng: np.random.Generator) -> Int64[np.ndarray, " K"]:
    """Some of the other views, drawn at random."""
    others = rng.choice(num - 1, min(WITNESSES, num - 1), replace=False)
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


def _typical_depth(witnesses: Witnesses, num: int) -> np.float32:
    """The median depth of all covered cells, for views that see none."""
    depths = witnesses.depths[np.isfinite(witnesses.depths)]
    if not len(depths):
        raise PointCloudError(
            "a point that lies in one of the views",
            found=f"none of {num}",
            fix="Check that points and cameras belong to the same scene.",
        )
    return np.float32(np.median(depths))


class _Growing:
    """A growing cloud, without a copy of everything for each view."""

    def __init__(self, xyz: Float32[np.ndarray, "N 3"]) -> None:
        self._room = xyz
        self._num = len(xyz)

    @property
    def xyz(self) -> Float32[np.ndarray, "N 3"]:
        return self._room[: self._num]

    def add(self, more: Float32[np.ndarray, "M 3"]) -> None:
        num = self._num + len(more)
        if num > len(self._room):
            # Doubled, so that all copies together are linear in the number of points.
            room = np.empty((2 * num, 3), np.float32)
            room[: self._num] = self.xyz
            self._room = room
        self._room[self._num : num] = more
        self._num = num


def _make_seeds(
    view: View,
    idx: int,
    cell: float,
    empty: Int64[np.ndarray, " M"],
    guess: tuple[Float32[np.ndarray, " M"], Float32[np.ndarray, " M"]],
    mask: Mask | None,
) -> CoverSeeds:
    """Seeds in empty cells at the guessed depths, except where too few pixels count."""
    depths, reach = guess
    shape = grid_shape(view.camera, cell)
    used = np.ones((1, 1), np.bool_) if mask is None else np.asarray(mask, np.bool_)
    rgb, usable = np.empty((len(empty), 3), np.uint8), np.empty(len(empty), np.bool_)
    _mean_colors(view.photograph, used, shape, empty, rgb, usable)
    xyz = np.empty((len(empty), 3), np.float32)
    _lift_all(world_from_grid(view, cell), shape[1], empty, depths, xyz)
    usable &= np.isfinite(xyz).all(axis=1)
    sides = depths * np.float32(_side_at_one(view, shape))
    # reach is 1 beside a covered cell.
    confidence = np.maximum(np.float32(MOST_CONFIDENT) / reach, np.float32(LEAST_CONFIDENT))
    of = np.full(len(empty), idx, np.int32)
    return CoverSeeds(*(each[usable] for each in (xyz, rgb, of, sides, confidence)))


def _side_at_one(view: View, shape: tuple[int, ...]) -> float:
    """Side of a cell at depth 1: the square root of its area."""
    width, height = view.width / shape[1] / view.K[0, 0], view.height / shape[0] / view.K[1, 1]
    return float(np.sqrt(abs(width * height)))


@inline
def _mean_colors(image, used, shape, empty, rgb, usable):  # type: ignore[no-untyped-def]  # Numba's types
    """The mean of each cell's pixels that count, and whether they make up half of it."""
    rows, cols = shape
    height, width = image.shape[:2]
    for k in range(len(empty)):
        i, j = divmod(empty[k], cols)
        total = np.zeros(3, np.int64)
        count, size = 0, 0
        for y in range(i * height // rows, (i + 1) * height // rows):
            for x in range(j * width // cols, (j + 1) * width // cols):
                size += 1
                if used.size == 1 or used[y, x]:
                    count += 1
                    for channel in range(3):
                        total[channel] += image[y, x, channel]
        usable[k] = count > 0 and 2 * count >= size
        for channel in range(3):
            # The mean rounded to the nearest, in whole numbers.
            rgb[k, channel] = (2 * total[channel] + count) // (2 * max(count, 1))


@inline
def _lift_all(m, cols, empty, depths, xyz):  # type: ignore[no-untyped-def]  # Numba's types
    """The points at these depths on the rays through the cells' centres."""
    point = np.empty(3)
    for k in range(len(empty)):
        i, j = divmod(empty[k], cols)
        lift(m, i, j, depths[k], point)
        xyz[k] = point
