"""Seeds in proportion to detail: up to a given number, closest together where contrast is high.

A third view must confirm pixels whose cells are smaller than the largest: two may agree by chance,
and wrong depths, which share a cell with no other, are chosen first.

Notation: the *contrast* of a pixel is the mean length of the grey gradient around it, relative to
the median over all confirmed pixels. At a *spacing* of s pixels, a pixel of contrast c has cells of
side s c^-e/2, within limits: e = 1 puts seeds in proportion to contrast, as
Structure-from-Motion's points are, e = 0 evenly. Sides are rounded to *levels*, s times powers of
sqrt(2) and the limits; level 0 has the largest cells.

Promise: seeds lie on confirmed depths only; the same maps give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, UInt8
from scipy.ndimage import uniform_filter

from splatseed.depth.stereo.fusion import CellGrids, Places, by_confidence, make_seeds
from splatseed.depth.stereo.maps import StereoResult
from splatseed.depth.stereo.matching import grey_image
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent

Steps = Int8[np.ndarray, "h w"]
WEAK = 127
"""Step of pixels that have the largest cells at any spacing."""
Placed = tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, " M"]]
"""Pixels of points in a view, and their depths."""


@dataclass(frozen=True)
class _DetailSettings:
    """How seeds follow detail, and the search for the spacing."""

    exponent: float = 1.0  # e: seeds per area ~ contrast^e
    closest: float = 2.0  # limit of spacing / side: edges in depth have contrast, too
    min_agreeing: int = 3  # views that confirm pixels with smaller cells than the largest
    floor: float = 0.5  # grey levels per pixel, added to every gradient: noise is no detail
    every: int = 7  # of the confirmed pixels, one in so many is used for the median contrast
    tolerance: float = 0.02  # share of the requested seeds that may be missing
    num_bisections: int = 30  # of the expected spacing
    share_finest: float = 0.1  # of the seeds, whose cells determine the grid
    max_steps: int = 12  # spacings tried
    finest: float = 1.0 / 64  # smallest spacing tried, relative to the largest cell


DETAIL = _DetailSettings()


@dataclass(frozen=True, eq=False)
class Levels:
    """Sides of cells from the largest down to the grid; those between are a factor apart."""

    sides: Float64[np.ndarray, " L"]
    spacing: float
    highest: int  # the second side is spacing * 2^(highest / 2)

    @classmethod
    def of(cls, spacing: float, largest: float, smallest: float) -> Levels:
        """Levels at a spacing, within limits; all in pixels."""
        low, high = (2 * math.log2(limit / spacing) for limit in (smallest, largest))
        steps = np.arange(math.ceil(high) - 1, math.floor(low), -1)
        sides = np.array([largest, *(spacing * 2.0 ** (steps / 2)), smallest])
        return cls(sides, spacing, math.ceil(high) - 1)

    def of_steps(self, steps: Steps) -> UInt8[np.ndarray, "h w"]:
        """Level of each pixel, by its ``steps_of`` contrast."""
        level = self.highest + 1 - steps.astype(np.int64)
        return np.asarray(np.clip(level, 0, len(self.sides) - 1), np.uint8)


def steps_of(stereo: StereoResult, i: int, contrast: Float32[np.ndarray, "h w"]) -> Steps:
    """2 log2 of side / spacing for each pixel of view i, rounded; ``WEAK`` without a third view."""
    steps = np.asarray(np.rint(-DETAIL.exponent * np.log2(contrast)), np.int8)
    steps[~_is_strong(stereo, i)] = WEAK
    return steps


def _is_strong(stereo: StereoResult, i: int) -> Bool[np.ndarray, "h w"]:
    """Whether as many views confirm each pixel as cells below the largest need."""
    num_sources = int((stereo.sources[i] >= 0).sum())
    needed = max(1, min(DETAIL.min_agreeing, num_sources))
    return np.asarray(np.bitwise_count(stereo.agreeing[i]) >= needed)


def find_contrast(stereo: StereoResult, radius: float) -> list[Float32[np.ndarray, "h w"]]:
    """Contrast of each grid point of all views, over a square of ``2 radius`` pixels."""
    grid = stereo.settings.grid
    size = max(1, round(2 * radius / grid))
    found = []
    for view in stereo.views:
        gradients = _gradient_length(grey_image(view.photograph))
        rows, columns = (side // grid for side in gradients.shape)
        blocks = gradients[: rows * grid, : columns * grid].reshape(rows, grid, columns, grid)
        means = uniform_filter(blocks.mean(axis=(1, 3)), size, mode="nearest")
        found.append(means + np.float32(DETAIL.floor))
    pixels = np.concatenate([c[stereo.confirmed(i)][:: DETAIL.every] for i, c in enumerate(found)])
    median = np.float32(np.median(pixels)) if len(pixels) else np.float32(1)
    return [c / median for c in found]


def side_of(contrast: Float32[np.ndarray, "..."], spacing: float) -> Float32[np.ndarray, "..."]:
    """Side of the cells of pixels of some contrast, without limits."""
    return np.asarray(spacing * contrast ** np.float32(-DETAIL.exponent / 2), np.float32)


def expected_spacing(stereo: StereoResult, num: int, largest: float) -> tuple[float, float]:
    """Estimate the spacing at which ``num`` seeds are chosen, in pixels of the views.

    Every seed at the grid's spacing stands for a square of surface, which holds one over the square
    of its cells' side times as many; the grid limits nothing.

    Args:
        stereo: The result of stereo.
        num: Number of seeds.
        largest: Side of the largest cells in pixels.

    Returns:
        The spacing, and the side of cells that a tenth of the seeds fall below; 0 without seeds.
    """
    grid = float(stereo.settings.grid)
    grids, found, weak = CellGrids.of(stereo.views, [grid]), [], 0
    for i, contrast in enumerate(find_contrast(stereo, largest / 2)):
        levels, strong = np.zeros(contrast.shape, np.uint8), _is_strong(stereo, i).ravel()
        pixels = grids.choose(stereo, i, by_confidence(stereo, i), levels).pixels
        found.append(contrast.ravel()[pixels[strong[pixels]]])
        weak += len(pixels) - len(found[-1])
    contrast = np.concatenate(found)
    if not len(contrast):
        return 0.0, 0.0
    num = max(num - round(weak * (grid / largest) ** 2), 1)
    low, high = DETAIL.finest * grid, largest / DETAIL.finest
    for _ in range(DETAIL.num_bisections):
        spacing = math.sqrt(low * high)
        sides = np.minimum(
            np.maximum(side_of(contrast, spacing), spacing / DETAIL.closest), largest
        )
        low, high = (low, spacing) if (grid**2 / sides**2).sum() < num else (spacing, high)
    seeds = 1 / sides**2
    order = np.argsort(sides)
    finest = order[np.searchsorted(np.cumsum(seeds[order]), DETAIL.share_finest * seeds.sum())]
    return spacing, float(sides[finest])


def fuse_at_most(
    stereo: StereoResult,
    num: int,
    largest: float,
    known: Sequence[Placed],
    spacing: float,
    progress: Progress = silent,
    split: int = 1,
) -> PointCloud:
    """Choose at most ``num`` seeds from confirmed pixels, in proportion to detail.

    Args:
        stereo: The result of stereo.
        num: Maximum number of seeds, nearly reached if enough pixels are confirmed. It is exceeded
            only if there are more of the largest cells.
        largest: Side of the largest cells in pixels of the views.
        known: Points that each view sees already: their cells get no seed.
        spacing: A guess of the spacing, from which the search starts.
        progress: Called with the stage and the fraction done.
        split: Places for seeds along a row and a column of a pixel of the maps.
    """
    chosen = _Search(stereo, largest, split, known, progress).run(num, spacing)
    return PointCloud.concatenate(
        *(make_seeds(stereo, i, each) for i, each in enumerate(chosen.places))
    )


@dataclass(frozen=True, eq=False)
class _Choice:
    """The places in each view that become seeds at a spacing."""

    places: list[Places]
    all_largest: bool  # no larger spacing gives fewer
    all_smallest: bool  # no smaller spacing gives more

    def __len__(self) -> int:
        return sum(map(len, self.places))


class _Search:
    """The spacing at which about a number of seeds is chosen."""

    def __init__(
        self,
        stereo: StereoResult,
        largest: float,
        split: int,
        known: Sequence[Placed],
        progress: Progress,
    ) -> None:
        self.stereo, self.known, self.progress = stereo, known, progress
        self.smallest, self.split = stereo.settings.grid / split, split
        self.largest = max(largest, self.smallest)
        # What follows from the contrast alone, in a byte per pixel.
        contrasts = find_contrast(stereo, largest / 2)
        self.steps = [steps_of(stereo, i, contrast) for i, contrast in enumerate(contrasts)]
        self.orders = [by_confidence(stereo, i) for i in range(len(stereo.views))]
        self.num_done = 0

    def choose(self, spacing: float) -> _Choice:
        """Choose the pixels that become seeds at a spacing."""
        smallest = max(self.smallest, spacing / DETAIL.closest)
        levels = Levels.of(spacing, self.largest, min(smallest, self.largest))
        grids = CellGrids.of(self.stereo.views, levels.sides.tolist())
        for i, (uv, z) in enumerate(self.known):
            grids.occupy(i, uv, z)
        places, limits = [], []
        for i, order in enumerate(self.orders):
            level = levels.of_steps(self.steps[i])
            places.append(grids.choose(self.stereo, i, order, level, self.split))
            strong = level[self.steps[i] != WEAK]
            limits += [strong.min(), strong.max()] if strong.size else []
            # The number of spacings is not known before: each fills half of what is left.
            share = 1 - 0.5**self.num_done * (1 - 0.5 * (i + 1) / len(self.orders))
            self.progress("fuse depths", share)
        self.num_done += 1
        last = len(levels.sides) - 1
        finest = min(limits, default=last) == last and smallest == self.smallest
        return _Choice(places, max(limits, default=0) == 0, finest)

    def run(self, num: int, spacing: float) -> _Choice:
        """Find the smallest spacing that gives at most ``num`` seeds, to ``tolerance``."""
        low, high = DETAIL.finest * self.largest, self.largest / DETAIL.finest
        spacing = min(max(spacing, low), high)
        best: _Choice | None = None
        for _ in range(DETAIL.max_steps):
            chosen = self.choose(spacing)
            if len(chosen) > num:
                low = spacing
                if chosen.all_largest:
                    best = chosen
                    break
            else:
                best, high = chosen, spacing
                if len(chosen) >= (1 - DETAIL.tolerance) * num or chosen.all_smallest:
                    break
            # number ~ 1 / spacing^2 on surfaces; fewer where cells are at a limit already
            target = (1 - DETAIL.tolerance / 2) * num
            guess = spacing * math.sqrt(max(len(chosen), 1) / target)
            spacing = guess if low < guess < high else math.sqrt(low * high)
        best = self.choose(high) if best is None else best
        self.progress("fuse depths", 1.0)
        return best


def _gradient_length(grey: UInt8[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Length of the gradient by central differences, grey levels per pixel; 0 at the border."""
    image = grey.astype(np.float32)
    across, down = np.zeros_like(image), np.zeros_like(image)
    across[:, 1:-1] = (image[:, 2:] - image[:, :-2]) / 2
    down[1:-1] = (image[2:] - image[:-2]) / 2
    return np.hypot(across, down)
