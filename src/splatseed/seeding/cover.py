"""Cover: a seed in every part of every photograph that no point covers.

Notation: cells, their depths and *covered* are defined in ``coverage``. Views are taken in random
order, each seeing the seeds of the views before. An empty cell gets one seed on the ray through its
centre, at the depth that ``guess`` estimates: a median over the covered cells around it, in which
depths count less if other views look through them. If a view has no covered cell, the median depth
of all views is used.
Promise: a cover seed is a guess and says so by its confidence; the same seed gives the same bytes
on any number of cores: views are processed one after another.

benchmarks/seeds/README.md says how the rule was chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8

from splatseed.errors import ParameterError, PointCloudError
from splatseed.kernels.jit import inline
from splatseed.progress import Progress, silent
from splatseed.seeding.coverage import cell_depths, check_points, grid_of
from splatseed.seeding.guess import (
    Witnesses,
    call_witnesses,
    guess_depths,
    lift,
    world_from_grid,
)
from splatseed.views.view import View

WITNESSES = 12
"""Other views that are asked whether they look through a seed."""
WITNESS_CELL = 8
"""Smallest cell of these views, in pixels."""
MOST_CONFIDENT, LEAST_CONFIDENT = 0.3, 0.1
"""Confidence of a seed beside a covered cell, and of one far from all."""

Mask = Bool[np.ndarray, "H W"]


@dataclass(frozen=True, eq=False)
class CoverSeeds:
    """Seeds in cells that no point covered, in the order in which the views were taken.

    Args:
        xyz: Positions, float32 [M, 3], world.
        rgb: Mean colour of the cell, uint8 [M, 3].
        view: The view each was made for, int32 [M].
        size: Side of the cell at the seed's depth, float32 [M], scene units.
        confidence: 0.3 beside a covered cell, falling to 0.1, float32 [M].
    """

    xyz: Float32[np.ndarray, "M 3"]
    rgb: UInt8[np.ndarray, "M 3"]
    view: Int32[np.ndarray, " M"]
    size: Float32[np.ndarray, " M"]
    confidence: Float32[np.ndarray, " M"]

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
    """A seed in every cell of every view that no point covers.

    Args:
        views: Photographs with their cameras.
        xyz: The existing points, in the world; those that are not finite are in no cell.
        cell: Side of a cell in pixels of the views, at least 1.
        rng: Draws the order of the views.
        masks: Which pixels of each view count; None for all. A cell gets a seed only if at least
            half of its pixels count.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: There is no view, a view has no pixels, ``cell`` is below 1, or masks do not
            fit.
        PointCloudError: ``xyz`` is not of shape [N, 3], or no point lies in any view.
    """
    xyz = check_points(views, xyz, cell)
    masks = _check_pixels(views, masks)
    witnesses = call_witnesses(views, xyz, max(cell, WITNESS_CELL), progress)
    typical = _typical_depth(witnesses, len(xyz))
    cloud = _Growing(xyz)
    parts = []
    for v in rng.permutation(len(views)):
        # Drawn for every view, empty cells or not: one view's gaps do not change the next's draw.
        asked = _draw_others(int(v), len(views), rng)
        depths = cell_depths(views[v], cloud.xyz, cell)
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
    """The median depth of all covered cells, for views that see none.

    Raises:
        PointCloudError: There are no covered cells.
    """
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
    shape = grid_of(view, cell)
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
