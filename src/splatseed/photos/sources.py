"""Source views: the views that each view is compared with.

Notation: V views and P points. The *score* of a pair of views is the sum, over the points that both
see, of a weight by the angle between their two rays.
Promise: pairs depend on poses and visibility only, not on threads or the order of points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.photos._kernels import add_pair_scores
from splatseed.projection import camera_centers
from splatseed.sampling import strided

ANGLES = (1.0, 4.0, 15.0, 45.0)
"""Degrees between a point's rays: the weight rises from 0 to 1 between the first two, and falls to
0 between the last two."""
MAX_POINTS = 4000  # points tested per view: more do not change the order of its pairs
MAX_AXIS_ANGLE = 30.0  # degrees between the axes of cameras that look the same way
COINCIDENT = 1e-6  # share of the median distance within which two cameras are at the same place
ROUNDING = 1e-12  # share of the largest distance that is rounding


def choose_sources(
    seen: Sequence[Int64[np.ndarray, " M"]],
    xyz: Float64[np.ndarray, "P 3"],
    centers: Float64[np.ndarray, "V 3"],
    num: int,
) -> Int64[np.ndarray, "V num"]:
    """The ``num`` source views of each view by score, best first; -1 where there are fewer.

    ``seen`` are the points that each view sees, as rows of ``xyz``.
    """
    count = len(seen)
    scores = np.zeros((count, count))
    if count > 1 and len(xyz):
        order, offsets = views_of_points(seen, len(xyz))
        sample = [strided(rows, MAX_POINTS) for rows in seen]
        starts = np.cumsum([0, *map(len, sample)])
        add_pair_scores(
            np.concatenate(sample), starts, xyz, centers, order, offsets, ANGLES, scores
        )
    best = np.argsort(-scores, axis=1, kind="stable")[:, :num]
    chosen = np.full((count, num), -1)
    chosen[:, : best.shape[1]] = np.where(np.take_along_axis(scores, best, 1) > 0, best, -1)
    return chosen


def choose_by_pose(
    cam_from_world: Float64[np.ndarray, "V 4 4"], num: int
) -> Int64[np.ndarray, "V num"]:
    """Source views from poses alone: nearby views that look the same way.

    The very nearest are skipped if there are enough others: their parallax is too small.
    """
    centers = camera_centers(cam_from_world)
    gap = np.linalg.norm(centers[:, None] - centers, axis=2)
    # The third row of a rotation is the camera's axis in the world.
    cosine = cam_from_world[:, 2, :3] @ cam_from_world[:, 2, :3].T
    chosen = np.full((len(centers), num), -1)
    for i in range(len(centers)):
        other = elsewhere(gap, i)
        alike = other[cosine[i, other] > np.cos(np.radians(MAX_AXIS_ANGLE))]
        if len(alike) < num:
            alike = other[np.argsort(-cosine[i, other], kind="stable")[:num]]
        near = alike[np.argsort(gap[i, alike], kind="stable")]
        # The nearest num / 2 are skipped, as far as the others suffice.
        near = near[min(num // 2, len(near) - min(num, len(near))) :][:num]
        chosen[i, : len(near)] = near
    return chosen


def elsewhere(gap: Float64[np.ndarray, "V V"], i: int) -> Int64[np.ndarray, " K"]:
    """Return the views at another place than view i, given the distances of all."""
    apart = gap[i][gap[i] > ROUNDING * gap.max()]
    # By the median, so that one camera far away does not make all others coincide.
    return np.flatnonzero(gap[i] > COINCIDENT * (np.median(apart) if len(apart) else np.inf))


def views_of_points(
    seen: Sequence[Int64[np.ndarray, " M"]], num_points: int
) -> tuple[Int64[np.ndarray, " T"], Int64[np.ndarray, " P+1"]]:
    """The views that see each point, point by point, and the start of each point's views in them.

    ``seen`` as in ``choose_sources``.
    """
    view = np.repeat(np.arange(len(seen)), [len(rows) for rows in seen])
    point = np.concatenate(seen)
    offsets = np.zeros(num_points + 1, np.int64)
    np.cumsum(np.bincount(point, minlength=num_points), out=offsets[1:])
    return view[np.argsort(point, kind="stable")], offsets
