"""Guesses of the depth of a view's empty cells, from surrounding covered cells and other views.

Notation: in each of eight sectors of 45 degrees around an empty cell the nearest covered cell is
consulted, up to ``2 r + 1`` cells away, where r is the distance of the first one. A seed at its
depth, on the ray through the empty cell's centre, is *contradicted* by another view if it lies in
front of a covered cell there, nearer by more than ``NEARER``: that view looks through it. The guess
is the median of the sectors' depths, weighted by ``1 / ((1 + contradictions) distance^2)``.
Promise: a guess is one of the view's depths; the bytes do not depend on the threads.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from splatseed.kernels.jit import inline
from splatseed.progress import Progress
from splatseed.seeding.coverage import NEARER, cell_depths, grid_from_world
from splatseed.views.projection import place
from splatseed.views.view import View

SECTORS = 8


@dataclass(frozen=True, eq=False)
class Witnesses:
    """The depths at which each of V views sees the initial points.

    Args:
        grid_from_world: To columns and rows of cells, and depth, float64 [V, 3, 4].
        shapes: Rows and columns of each view, int64 [V, 2].
        starts: Start of each view's depths, int64 [V].
        depths: Of all cells, view by view and row by row, float32; infinite where not covered.
    """

    grid_from_world: Float64[np.ndarray, "V 3 4"]
    shapes: Int64[np.ndarray, "V 2"]
    starts: Int64[np.ndarray, " V"]
    depths: Float32[np.ndarray, " C"]


def call_witnesses(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], cell: float, progress: Progress
) -> Witnesses:
    """The depths at which each view sees the points, on cells of ``cell`` pixels."""
    maps: list[Float32[np.ndarray, "rows cols"]] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # the kernels release the GIL
        for depths in pool.map(lambda view: cell_depths(view, xyz, cell), views):
            maps.append(depths)
            progress("look for uncovered cells", len(maps) / len(views))
    sizes = np.array([depths.size for depths in maps])
    return Witnesses(
        np.stack([grid_from_world(view, cell) for view in views]),
        np.array([depths.shape for depths in maps]),
        np.cumsum(sizes) - sizes,
        np.concatenate([depths.ravel() for depths in maps]),
    )


def world_from_grid(view: View, cell: float) -> Float64[np.ndarray, "3 4"]:
    """(column depth, row depth, depth, 1) to the world, columns and rows in cells.

    Float64 [3, 4].
    """
    forward = np.vstack([grid_from_world(view, cell), [0.0, 0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(forward)[:3])


def guess_depths(
    depths: Float32[np.ndarray, "rows cols"],
    empty: Int64[np.ndarray, " M"],
    back: Float64[np.ndarray, "3 4"],
    witnesses: Witnesses,
    asked: Int64[np.ndarray, " K"],
) -> tuple[Float32[np.ndarray, " M"], Float32[np.ndarray, " M"]]:
    """The depth of each empty cell, and its distance in cells to the nearest covered one.

    Args:
        depths: Of the view's cells, infinite where not covered; at least one is covered.
        empty: The cells to guess, as row * cols + column.
        back: The view's ``world_from_grid``.
        witnesses: What all views see.
        asked: Which of them may contradict.
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
        column, row, depth = place(point, matrices[v])
        if depth > 0.0:
            rows, cols = shapes[v]
            if 0.0 <= column < cols and 0.0 <= row < rows:
                there = seen[starts[v] + int(row) * cols + int(column)]
                # In front of a covered cell by more than NEARER: that view sees past it.
                count += there < np.inf and depth < there * (1.0 - NEARER)
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
