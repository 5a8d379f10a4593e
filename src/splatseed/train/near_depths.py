"""How close any photograph gets to each point: the unit of its Gaussian's size and learning rate.

Notation: N points and the training views, both in the training frame; a *near depth* is the
smallest depth at which a view sees a point. A length divided by it is an angle, so a rate or size
in units of near depth looks the same in the photographs wherever a Gaussian is: in front of closely
spaced cameras, on a table between them, or far behind both. 3DGS uses the cameras' extent for all.
Promise: every near depth is positive and finite; the same bytes whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32

from splatseed.views.view import View

MOST_PROJECTIONS = 20_000_000
"""Limit on points times views: beyond it, an even subset of the views is used."""
LEAST_VIEWS = 64
"""But never fewer views than this."""
MARGIN = 0.1
"""A point outside the photograph by up to this fraction of its size counts as seen: a large
Gaussian there reaches in."""
LEAST = 0.01
"""The rasteriser's near plane: nothing nearer is drawn."""


def near_depths(xyz: Float[np.ndarray, "N 3"], views: Sequence[View]) -> Float32[np.ndarray, " N"]:
    """The smallest depth of each point among the views that see it; the median if none does.

    Args:
        xyz: Points.
        views: The training views; see ``MOST_PROJECTIONS``.
    """
    nearest = np.full(len(xyz), np.inf)
    columns = np.ascontiguousarray(xyz.T, np.float64)
    # Evenly spaced views, the first and the last among them.
    asked = max(LEAST_VIEWS, MOST_PROJECTIONS // max(1, len(xyz)))
    for i in np.unique(np.linspace(0, len(views) - 1, min(asked, len(views))).round().astype(int)):
        depths, seen = _seen_depths(columns, views[i])
        np.minimum(nearest, np.where(seen, depths, np.inf), out=nearest)
    known = np.isfinite(nearest)
    # A point that no view sees gets no gradient; any positive length will do.
    nearest[~known] = np.median(nearest[known]) if known.any() else 1.0
    return np.asarray(np.maximum(nearest, LEAST), np.float32)


def _seen_depths(
    columns: Float[np.ndarray, "3 N"], view: View
) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Depths in a view, and whether points are in front of it and roughly within its frame."""
    # Sums are written out: BLAS may add in another order when it has more threads.
    x, y, depths = (
        row[0] * columns[0] + row[1] * columns[1] + row[2] * columns[2] + row[3]
        for row in view.cam_from_world[:3]
    )
    seen = depths > LEAST
    for across, focal, center, size in (
        (x, view.K[0, 0], view.K[0, 2], view.width),
        (y, view.K[1, 1], view.K[1, 2], view.height),
    ):
        # Multiplied by the depth, so that nothing is divided by zero.
        seen &= focal * across >= (-MARGIN * size - center) * depths
        seen &= focal * across <= ((1 + MARGIN) * size - center) * depths
    return depths, seen
