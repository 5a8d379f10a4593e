"""Which other views to ask about a view's points.

Notation: V views, S sample points of each. A view *covers* a sample of another, with a weight by
the angle between the two cameras' rays to it. Promise: neighbours are chosen one after another,
each for the samples that the ones before cover least.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.depth.views import View
from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.progress import Progress, in_threads
from splatseed.views.parallax import cosine_between
from splatseed.views.projection import place

SAMPLES = 40
"""Candidates of a view by which its neighbours are judged."""
MIN_SAMPLES = 4
"""But never fewer, however many views there are."""
WORK = 1 << 28
"""Limit on projections: the more views, the fewer samples of each."""
SHORTLIST = 2
"""Views on the shortlist, per neighbour chosen."""
FULL = 0.03
"""1 - cos of the angle from which on (14 degrees) a view covers fully; up to 60 degrees."""
LEAST = 0.05
"""Weight of rays that coincide."""
SEEN = 0.25
"""A view sees a sample if its own depth there differs by less than this fraction."""
MOST_COLUMNS = 1e6
"""More columns than any grid has."""
PIECE = 8
"""Views per task of a thread."""


def choose_neighbors(
    views: Sequence[View], num: int, progress: Progress
) -> Int64[np.ndarray, "V num"]:
    """The ``num`` views to ask about each view's points, best first, int64 [V, num]; -1 = no more.

    Args:
        views: All views; those without a reduced copy neither ask nor answer.
        num: How many.
        progress: Called with the stage and the fraction done.
    """
    chosen = np.full((len(views), num), -1)
    usable = np.array([i for i, v in enumerate(views) if v.reduced is not None and len(v)], int)
    if len(usable) < 2:
        return chosen
    # V^2 S projections for the shortlist.
    per_view = int(np.clip(WORK // len(usable) ** 2, MIN_SAMPLES, SAMPLES))
    samples = np.full((len(usable), per_view, 3), np.inf, np.float32)  # seen by nobody
    for i, k in enumerate(usable.tolist()):
        own = views[k].samples(per_view)
        samples[i, : len(own)] = own
    grids = [copy for k in usable.tolist() if (copy := views[k].reduced) is not None]
    matrices = np.stack([grid.grid_from_world for grid in grids])
    sizes = np.array([grid.z.shape for grid in grids])
    centers = np.stack([views[k].camera.center for k in usable.tolist()])
    # First a shortlist by frames alone, then ``num`` of it by what each sees according to its map.
    shortlist = np.full((len(usable), SHORTLIST * num), -1)
    _shortlist(samples, matrices, sizes, centers, shortlist)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            listed = shortlist[i][shortlist[i] >= 0]
            covers = np.zeros((len(listed), per_view))
            for row, j in zip(covers, listed.tolist(), strict=True):
                _weigh(samples[i], matrices[j], sizes[j], centers[i], centers[j], row)
                _keep_seen(samples[i], matrices[j], grids[j].z, grids[j].factor, row)
            best = _cover(covers, num)
            chosen[usable[i], : len(best)] = usable[listed[best]]

    in_threads(work, len(usable), PIECE, "choose neighbours", progress)
    return chosen


def _cover(covers: Float64[np.ndarray, "J S"], num: int) -> Int64[np.ndarray, " K"]:
    """Up to ``num`` of the rows, each chosen for what the rows before it cover least."""
    out = np.full(num, -1)
    _choose(covers, out)
    return out[out >= 0]


@kernel
def _shortlist(samples, matrices, sizes, centers, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Views whose frames cover the samples of each view."""
    num, per_view = samples.shape[0], samples.shape[1]
    for i in parallel_range(num):
        covers = np.zeros((num, per_view))
        for j in range(num):
            if j != i:
                _weigh(samples[i], matrices[j], sizes[j], centers[i], centers[j], covers[j])
        _choose(covers, out[i])


@inline
def _choose(covers, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Rows one after another by the sum of w / (1 + covered)^2, until none adds anything."""
    covered, worth = np.zeros(covers.shape[1]), np.ones(covers.shape[1])
    free = np.ones(len(covers), np.bool_)
    for k in range(min(len(out), len(covers))):
        best, most = -1, 0.0
        for j in range(len(covers)):
            if free[j]:
                gain = 0.0
                for s in range(covers.shape[1]):
                    gain += covers[j, s] * worth[s]
                if gain > most:
                    best, most = j, gain
        if best < 0:
            break
        out[k] = best
        free[best] = False
        covered += covers[best]
        # A sample that one full neighbour covers is worth a quarter to the next.
        worth = 1.0 / (1.0 + covered) ** 2


@inline
def _weigh(samples, m, size, center, other, out):  # type: ignore[no-untyped-def]  # Numba's types
    """How well a view covers each sample, by frame and angle."""
    for s in range(len(samples)):
        depth, column, row = _nearest(samples[s], m)
        if 0.0 < depth < np.inf and 0 <= column < size[1] and 0 <= row < size[0]:
            out[s] = _angle_weight(samples[s], center, other)


@inline
def _keep_seen(samples, m, z, factor, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Remove samples that are hidden from the view or unknown to it."""
    for s in range(len(samples)):
        if out[s] > 0.0:
            depth, column, row = _nearest(samples[s], m)
            if not abs(factor * z[row, column] / depth - 1.0) < SEEN:
                out[s] = 0.0


@inline
def _nearest(point, m):  # type: ignore[no-untyped-def]  # Numba's types
    """Depth of a point in a view, and the nearest grid point; column -1 if there is none."""
    column, row, depth = place(point, m)
    column, row = column + 0.5, row + 0.5
    if not (0.0 <= column < MOST_COLUMNS and 0.0 <= row < MOST_COLUMNS):
        return depth, -1, -1
    return depth, int(column), int(row)


@inline
def _angle_weight(point, first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """Small where the rays coincide, rising to 1, and 0 where they are 90 degrees apart."""
    # From one place a sensor errs alike; from 90 degrees on, the other side of a surface is seen.
    cosine = cosine_between(point, first, second)
    return min(max((1.0 - cosine) / FULL, LEAST), 1.0) * min(max(2.0 * cosine, 0.0), 1.0)
