"""Which views to compare each view with: those that see the same places from another side.

Notation: V views, P points. The *worth* of a pair is the sum, over the points that both see, of a
weight by the angle between their two rays.
Promise: the pairs depend on poses and visibility only, not on threads or the order of points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.runtime.jit import inline, kernel, parallel_range
from splatseed.views.projection import cosine_between

LEAST, FULL, WIDE, MOST = 1.0, 4.0, 15.0, 45.0
"""Degrees between which the weight rises, stays full, and falls."""
ALIKE = 30.0
"""Largest angle in degrees between the axes of cameras that look the same way."""
SAME_PLACE = 1e-6
"""Share of the cameras' spread within which two cameras count as coincident."""
MOST_POINTS = 4000
"""Points tested per view: more do not change the order of its pairs."""


def choose_sources(
    seen: Sequence[Int64[np.ndarray, " M"]],
    xyz: Float64[np.ndarray, "P 3"],
    centers: Float64[np.ndarray, "V 3"],
    num: int,
) -> Int64[np.ndarray, "V num"]:
    """The ``num`` views to compare each view with, best first, int64 [V, num]; -1 for none.

    Args:
        seen: The points that each view sees, as rows of ``xyz``.
        xyz: World positions, float64 [P, 3].
        centers: The cameras' positions, float64 [V, 3].
        num: How many views to choose.
    """
    count = len(seen)
    worth = np.zeros((count, count))
    if count > 1 and len(xyz):
        order, offsets = views_of_points(seen, len(xyz))
        asked = [each[:: -(-len(each) // MOST_POINTS) or 1] for each in seen]
        starts = np.cumsum([0, *map(len, asked)])
        rows = np.concatenate(asked)
        _add_up(rows, starts, xyz, centers, order, offsets, worth)
    best = np.argsort(-worth, axis=1, kind="stable")[:, :num]
    chosen = np.full((count, num), -1)
    chosen[:, : best.shape[1]] = np.where(np.take_along_axis(worth, best, 1) > 0, best, -1)
    return chosen


def choose_by_pose(
    cam_from_world: Float64[np.ndarray, "V 4 4"], num: int
) -> Int64[np.ndarray, "V num"]:
    """The same from poses alone: nearby views that look the same way.

    The very nearest are skipped if there are enough others: their parallax is too small.
    """
    centers = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    gap = np.linalg.norm(centers[:, None] - centers, axis=2)
    # The third row of a rotation is the camera's axis in the world.
    cosine = cam_from_world[:, 2, :3] @ cam_from_world[:, 2, :3].T
    chosen = np.full((len(centers), num), -1)
    for i in range(len(centers)):
        other = np.flatnonzero(gap[i] > SAME_PLACE * gap.max())
        alike = other[cosine[i, other] > np.cos(np.radians(ALIKE))]
        if len(alike) < num:
            alike = other[np.argsort(-cosine[i, other], kind="stable")[:num]]
        near = alike[np.argsort(gap[i, alike], kind="stable")]
        # The nearest num / 2 are skipped, as far as the others suffice.
        near = near[min(num // 2, len(near) - min(num, len(near))) :][:num]
        chosen[i, : len(near)] = near
    return chosen


def views_of_points(
    seen: Sequence[Int64[np.ndarray, " M"]], num_points: int
) -> tuple[Int64[np.ndarray, " T"], Int64[np.ndarray, " P+1"]]:
    """The views of each point, int64 [T], and where each point's begin, int64 [P + 1].

    Args:
        seen: The points that each view sees, as rows from 0 to ``num_points``.
        num_points: P.
    """
    view = np.repeat(np.arange(len(seen)), [len(each) for each in seen])
    point = np.concatenate(seen)
    offsets = np.zeros(num_points + 1, np.int64)
    np.cumsum(np.bincount(point, minlength=num_points), out=offsets[1:])
    return view[np.argsort(point, kind="stable")], offsets


@kernel
def _add_up(rows, starts, xyz, centers, order, offsets, worth):  # type: ignore[no-untyped-def]  # Numba's types
    """The worth of all pairs."""
    for i in parallel_range(len(centers)):
        for k in range(starts[i], starts[i + 1]):
            point = rows[k]
            for t in range(offsets[point], offsets[point + 1]):
                j = order[t]
                if j != i:
                    worth[i, j] += _weight(xyz[point], centers[i], centers[j])


@inline
def _weight(point, first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """The weight of a point by the angle between its rays to two cameras."""
    cosine = cosine_between(point, first, second)
    angle = np.degrees(np.arccos(min(max(cosine, -1.0), 1.0)))
    # Where the rays nearly coincide, depth hardly moves a point in the photographs.
    rising = min(max((angle - LEAST) / (FULL - LEAST), 0.0), 1.0)
    # Beyond WIDE degrees a surface looks different.
    falling = min(max((MOST - angle) / (MOST - WIDE), 0.0), 1.0)
    return rising * falling
