"""Which pixels of a map to lift: known ones, away from discontinuities, where SfM has few points.

Notation: a map is H x W; ``cells`` are squares of ``step`` pixels with a weight each; a pixel's
number is row * W + column. w = 1 / depth is linear in the image on a plane at any slant, so
w(-k) + w(+k) = 2 w(0) there, and a discontinuity shows as a residual. Promise: no pixel is drawn
twice; at least as many are drawn as are asked for, or all there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatseed.depth.settings import Settings
from splatseed.kernels.jit import inline

CELLS = 64
"""Most cells along the longer side of a map."""

ROUNDS = 4
"""Most rounds of drawing, each for what the last has left missing."""
DIAGONAL = 2.0**0.5
"""Length of a diagonal step, in cells."""
LEAST_DISTANCE = 0.5
"""Distance, in cells, given to a cell that has points itself: it stays open to new ones."""

SURPLUS = 1.15
"""Overdraw factor: some pixels will be unknown or near a discontinuity."""
LEAST_SHARE = 0.05
"""Fraction of the drawn pixels that is assumed usable."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """Pixels drawn from one map.

    Args:
        pixel: Their numbers, int64 [C].
        edge: Which lie near a depth discontinuity, bool [C]: taken only when nothing else is left.
    """

    pixel: Int64[np.ndarray, " C"]
    edge: Bool[np.ndarray, " C"]


def sample_pixels(
    values: Float32[np.ndarray, "H W"],
    num: int,
    points: Float64[np.ndarray, "M 2"],
    settings: Settings,
    rng: np.random.Generator,
) -> Drawn:
    """Draw ``num`` distinct pixels with depth, or a few more; fewer if the map has fewer.

    Args:
        values: The map: positive where known, else NaN.
        num: How many.
        points: Where SfM points are, in pixels of the map.
        settings: Region, placement and edges.
        rng: Draws them.
    """
    box = _region(values.shape, settings.region)
    step = -(-max(values.shape) // CELLS)
    weight = _cell_weights(values.shape, step, points, settings)
    cumulative = np.cumsum(weight, dtype=np.float64)
    edges = _edges(settings)
    pixel, tried = np.empty(0, np.int64), 0
    for _ in range(ROUNDS):
        missing = num - len(pixel)
        if missing <= 0:
            break
        # The share of usable pixels so far tells how many to try.
        will_do = max(len(pixel) / tried, LEAST_SHARE) if tried else 1.0
        picks = _picks(int(SURPLUS * missing / will_do) + 1, settings.placement, rng)
        # Inverse of the cumulative weight: a cell is drawn in proportion to its weight.
        picks *= cumulative[-1]
        jitter = rng.random((len(picks), 2), dtype=np.float32)
        part = np.empty(len(picks), np.int64)
        drawn = _draw(values, cumulative, weight.shape[1], step, box, picks, jitter, *edges, part)
        pixel = part[:drawn] if not tried else np.unique(np.concatenate([pixel, part[:drawn]]))
        tried += len(picks)
    if len(pixel) < num:
        return _with_rest(values, pixel, num, box, edges, rng)
    return Drawn(pixel, np.zeros(len(pixel), np.bool_))


def _region(shape: tuple[int, int], share: float) -> tuple[int, int, int, int]:
    """Top, left, bottom and right of the central share of each dimension, in pixels."""
    top, left = (round(0.5 * (1.0 - share) * size) for size in shape)
    return top, left, shape[0] - top, shape[1] - left


def _edges(settings: Settings) -> tuple[int, float]:
    """Radius and tolerance of the discontinuity test; radius 0 passes all."""
    if settings.edge_tolerance is None:
        return 0, np.inf
    return settings.edge_radius, settings.edge_tolerance


def _cell_weights(
    shape: tuple[int, int], step: int, points: Float64[np.ndarray, "M 2"], settings: Settings
) -> Float64[np.ndarray, "R C"]:
    """Weight of every cell: the root of its distance to the nearest one with an SfM point, or 1.

    The distance itself would leave too little for the surroundings of points: compared with
    held-out frames of two captures, the root leaves the smallest gaps.
    """
    rows, columns = -(-shape[0] // step), -(-shape[1] // step)
    if settings.placement == "uniform" or not len(points):
        return np.ones((rows, columns))
    distance = np.full((rows, columns), np.inf)
    column, row = (points // step).astype(np.int64).T
    distance[row, column] = 0.0
    _spread_distance(distance)
    return np.asarray(np.sqrt(np.maximum(distance, LEAST_DISTANCE)))


def _picks(num: int, placement: str, rng: np.random.Generator) -> Float64[np.ndarray, " num"]:
    """Ascending numbers in [0, 1): independent, or stratified with one in each ``num``-th."""
    if placement == "uniform":
        return np.sort(rng.random(num))
    return (np.arange(num) + rng.random(num)) / num


def _with_rest(
    values: Float32[np.ndarray, "H W"],
    pixel: Int64[np.ndarray, " C"],
    num: int,
    box: tuple[int, int, int, int],
    edges: tuple[int, float],
    rng: np.random.Generator,
) -> Drawn:
    """The drawn pixels and as many others as are missing, whatever their weight, edges last."""
    top, left, bottom, right = box
    free = np.zeros(values.shape, bool)
    inner = values[top:bottom, left:right]
    free[top:bottom, left:right] = (inner > 0) & (inner < np.inf)
    free.ravel()[pixel] = False
    rest = rng.permutation(np.flatnonzero(free))
    edge = np.empty(len(rest), np.bool_)
    _mark_edges(values, rest, *edges, edge)
    chosen = np.argsort(edge, kind="stable")[: num - len(pixel)]
    edge = np.concatenate([np.zeros(len(pixel), np.bool_), edge[chosen]])
    return Drawn(np.concatenate([pixel, rest[chosen]]), edge)


@inline
def _spread_distance(distance):  # type: ignore[no-untyped-def]  # Numba's types
    """Chamfer distances from a grid's zeros, in place, at most 8% too long (Borgefors, 1986)."""
    rows, columns = distance.shape
    # Forward from the upper left, then backward from the lower right.
    for sweep in range(2):
        for a in range(rows):
            row = a if sweep == 0 else rows - 1 - a
            before = row - 1 if sweep == 0 else row + 1
            for b in range(columns):
                column = b if sweep == 0 else columns - 1 - b
                beside = column - 1 if sweep == 0 else column + 1
                least = distance[row, column]
                if 0 <= beside < columns:
                    least = min(least, distance[row, beside] + 1.0)
                if 0 <= before < rows:
                    least = min(least, distance[before, column] + 1.0)
                    if column > 0:
                        least = min(least, distance[before, column - 1] + DIAGONAL)
                    if column < columns - 1:
                        least = min(least, distance[before, column + 1] + DIAGONAL)
                distance[row, column] = least


@inline
def _draw(values, cumulative, columns, step, box, picks, jitter, radius, tolerance, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Pixels in the cells that ascending ``picks`` fall into; returns the number of usable ones."""
    top, left, bottom, right = box
    cell, count, first = 0, 0, 0  # out[first:count] belong to this cell
    for k in range(len(picks)):
        while cell < len(cumulative) - 1 and cumulative[cell] <= picks[k]:
            cell += 1
            first = count
        row = cell // columns * step + int(jitter[k, 0] * step)
        column = cell % columns * step + int(jitter[k, 1] * step)
        if row < top or row >= bottom or column < left or column >= right:
            continue
        pixel = row * values.shape[1] + column
        if not 0 < values[row, column] < np.inf or _contains(out[first:count], pixel):
            continue
        if radius == 0 or not _near_edge(values, row, column, radius, tolerance):
            out[count] = pixel
            count += 1
    return count


@inline
def _contains(numbers, number):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether a short list contains a number."""
    for each in numbers:  # noqa: SIM110  (Numba has no any() of a generator)
        if each == number:
            return True
    return False


@inline
def _mark_edges(values, pixel, radius, tolerance, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Which of the pixels lie near a depth discontinuity."""
    width = values.shape[1]
    for k in range(len(pixel)):
        row, column = pixel[k] // width, pixel[k] % width
        out[k] = radius > 0 and _near_edge(values, row, column, radius, tolerance)


@inline
def _near_edge(values, row, column, radius, tolerance):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether 1 / depth bends within ``radius``, across, down or diagonally, or is mostly unknown.

    All distances are tested along the row, where memory is near, and only the largest one
    elsewhere: there, a discontinuity that is crossed twice can be missed.
    """
    # w(-k) + w(+k) - 2 w(0), relative to w(0): 0 on any plane
    here = 2.0 / values[row, column]
    known, pairs = 0, 0
    for k in range(1, radius + 4):
        dy, dx = 0, k
        if k > radius:
            dy, dx = radius, radius * (k - radius - 2)
        y0, x0, y1, x1 = row - dy, column - dx, row + dy, column + dx
        if y0 < 0 or y1 >= values.shape[0] or min(x0, x1) < 0 or max(x0, x1) >= values.shape[1]:
            continue
        pairs += 1
        before, after = values[y0, x0], values[y1, x1]
        if 0 < before < np.inf and 0 < after < np.inf:
            known += 1
            if abs(1.0 / before + 1.0 / after - here) > 0.5 * tolerance * here:
                return True
    # Beside unknown depth there may be an edge, too.
    return 2 * known < pairs
