"""The views that judge a new point: those with the best sight of it.

Notation: M new points, V views; the *base* of a point is the original it is nearest to. A view may
judge a point if it sees its base, and the point lies well within its frame and within those of two
of its sources (of its only one, if it has no more). The closer and the more frontal a view, the
better it sees the point. Promise: the judges of a point depend on that point, the poses and
visibility, not on the other points or on threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int64

from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.seeding.surroundings import Surroundings
from splatseed.views.pairs import views_of_points
from splatseed.views.projection import place
from splatseed.views.view import View

JUDGES = 2
"""Views that judge a point; the better verdict counts, as one of them may not see it after all."""
WITNESSES = 2
"""Sources that must contain a point: this many determine its cost."""
MARGIN = 5.0
"""Pixels between a point and the frame: the window around it lies inside."""
OBLIQUE = 0.3
"""Weight of closeness for a surface seen edge on: normals are uncertain."""


def choose_judges(
    xyz: Float32[np.ndarray, "M 3"],
    around: Surroundings,
    views: Sequence[View],
    seen: Sequence[Int64[np.ndarray, " N"]],
    num_originals: int,
    sources: Int64[np.ndarray, "V K"],
) -> Int64[np.ndarray, "M J"]:
    """The views that judge each point, best first, int64 [M, JUDGES]; -1 where there is none.

    Args:
        xyz: New points, world positions.
        around: Their bases and normals.
        views: The views.
        seen: The originals that each view sees.
        num_originals: The number of originals.
        sources: The views that each is compared with; -1 = none.
    """
    order, offsets = views_of_points(seen, num_originals)
    poses = np.stack([view.cam_from_world for view in views])
    matrices = np.stack([view.K @ view.cam_from_world[:3] for view in views])
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    sizes = np.array([(view.width, view.height) for view in views], np.float64)
    focals = np.array([view.K[0, 0] for view in views])
    judges = np.full((len(xyz), JUDGES), -1)
    normals = np.nan_to_num(around.normals)
    _choose(
        xyz, around.base, normals, order, offsets, matrices, sizes, centers, focals,
        sources, judges,
    )  # fmt: skip
    return judges


@kernel
def _choose(  # type: ignore[no-untyped-def]  # Numba's types
    xyz, base, normals, order, offsets, matrices, sizes, centers, focals, sources, judges
):
    """The best views of each point."""
    for i in parallel_range(len(xyz)):
        worth = np.zeros(JUDGES)
        for t in range(offsets[base[i]], offsets[base[i] + 1]):
            view = order[t]
            if not _holds(matrices[view], sizes[view], xyz[i]):
                continue
            if not _has_witnesses(xyz[i], sources[view], matrices, sizes):
                continue
            # Pixels per unit of length at the point, weighted by the angle.
            value = focals[view] * _sight(xyz[i], normals[i], centers[view])
            # Insertion into a sorted list of two.
            for k in range(JUDGES):
                if value > worth[k]:
                    for after in range(JUDGES - 1, k, -1):
                        worth[after], judges[i, after] = worth[after - 1], judges[i, after - 1]
                    worth[k], judges[i, k] = value, view
                    break


@inline
def _has_witnesses(point, sources, matrices, sizes):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether enough of a view's sources contain a point."""
    asked, holding = 0, 0
    for other in sources:
        if other >= 0:
            asked += 1
            holding += _holds(matrices[other], sizes[other], point)
    return holding > 0 and holding >= min(asked, WITNESSES)


@inline
def _holds(matrix, size, point):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether a point lies in front of a camera and well within its frame."""
    u, v, z = place(point, matrix)
    inside = MARGIN <= u <= size[0] - MARGIN and MARGIN <= v <= size[1] - MARGIN
    return z > 0.0 and inside


@inline
def _sight(point, normal, center):  # type: ignore[no-untyped-def]  # Numba's types
    """How well a surface is seen: (cos of the angle to its normal + OBLIQUE) / distance."""
    dot, squared = 0.0, 0.0
    for axis in range(3):
        ray = point[axis] - center[axis]
        dot += ray * normal[axis]
        squared += ray * ray
    distance = np.sqrt(squared)
    return (abs(dot) / distance + OBLIQUE) / distance
