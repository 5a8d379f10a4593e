"""Which other views to ask about a view's points.

Notation: V views, S sample points of each; the rays of two cameras to a point enclose an angle. Promise:
a view's neighbours are those that have most of its samples in their frame, each sample counted by the
angle: rays that nearly coincide confirm little, since a sensor errs alike from one place, and rays more
than 90 degrees apart look at the other side of a surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from splatseed.depth.views import View
from splatseed.jit import inline, kernel, parallel_range

__all__ = ["choose_neighbors"]

SAMPLES = 32
MIN_SAMPLES = 4
WORK = 1 << 28
"""Projections at most: the more views, the fewer samples of each."""

FULL = 0.03
"""1 - cos of the angle from which on (14 degrees) it counts fully; up to 60 degrees."""
LEAST = 0.02
"""What rays that coincide count."""


def choose_neighbors(views: Sequence[View], num: int) -> Int64[np.ndarray, "V num"]:
    """The ``num`` views to ask about each view's points, best first, int64 [V, num]; -1 = no more.

    Args:
        views: All of them; those without a reduced copy neither ask nor answer.
        num: How many.
    """
    usable = [i for i, view in enumerate(views) if view.reduced is not None and len(view)]
    chosen = np.full((len(views), num), -1)
    if len(usable) < 2:
        return chosen
    per_view = int(np.clip(WORK // len(usable) ** 2, MIN_SAMPLES, SAMPLES))
    samples = np.full((len(usable), per_view, 3), np.inf, np.float32)  # seen by nobody
    for i, k in enumerate(usable):
        own = views[k].samples(per_view)
        samples[i, : len(own)] = own
    grids = [reduced for i in usable if (reduced := views[i].reduced) is not None]
    matrices = np.stack([grid.grid_from_world for grid in grids])
    sizes = np.array([grid.z.shape for grid in grids])
    centers = np.stack([views[i].camera.center for i in usable])
    found = np.full((len(usable), num), -1)
    _rank(samples, matrices, sizes, centers, found)
    lookup = np.array([*usable, -1])  # an index of -1 stays one
    chosen[usable] = lookup[found]
    return chosen


@kernel
def _rank(samples, matrices, sizes, centers, found):  # type: ignore[no-untyped-def]
    """The best-scored views of every view, by repeated selection of the best."""
    for i in parallel_range(len(samples)):
        score = np.empty(len(samples))
        for j in range(len(samples)):
            score[j] = 0.0 if i == j else _score(i, j, samples, matrices, sizes, centers)
        for k in range(min(found.shape[1], len(samples) - 1)):
            best = int(np.argmax(score))
            if score[best] <= 0.0:
                break
            found[i, k] = best
            score[best] = 0.0


@inline
def _score(i, j, samples, matrices, sizes, centers):  # type: ignore[no-untyped-def]
    """Samples of view i that are in the frame of view j, each weighted by the angle of its rays."""
    total = 0.0
    m = matrices[j]
    for s in range(samples.shape[1]):
        x, y, z = (
            np.float64(samples[i, s, 0]),
            np.float64(samples[i, s, 1]),
            np.float64(samples[i, s, 2]),
        )
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if not 0.0 < depth < np.inf:
            continue
        column = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
        row = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
        if 0.0 <= column <= sizes[j, 1] - 1 and 0.0 <= row <= sizes[j, 0] - 1:
            total += _angle_weight(samples[i, s], centers[i], centers[j])
    return total


@inline
def _angle_weight(point, first, second):  # type: ignore[no-untyped-def]
    """From little where the rays coincide to 1, and to 0 where they are 90 degrees apart."""
    dot, first_squared, second_squared = 0.0, 0.0, 0.0
    for axis in range(3):
        a, b = point[axis] - first[axis], point[axis] - second[axis]
        dot += a * b
        first_squared += a * a
        second_squared += b * b
    cosine = dot / np.sqrt(first_squared * second_squared)
    return min(max((1.0 - cosine) / FULL, LEAST), 1.0) * min(max(2.0 * cosine, 0.0), 1.0)
