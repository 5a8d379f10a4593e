"""The nearest points of a kd-tree, in an order that the tree's own cuts have no say in.

Notation: a point's *number* is its place in the array that the tree was built from. Promise: equal
distances are ordered by number, also where the k-th of them is as far as the next, so that the
answer follows from the points alone: any tree over the same points, and any division of them among
several trees, gives the same neighbours.
"""

from __future__ import annotations

import sys

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.spatial import cKDTree

AT_ONCE = 1 << 20
"""Neighbours fetched at once for points at whose k-th distance there are several."""
FEW = 1 << 22
"""Distances up to which NumPy is quick enough where Numba is not loaded, as in ``splatseed info``;
the kernel gives the same bytes."""
ROWS = 1 << 14
"""Points at a time, so that what is computed on the way stays in the cache."""


def nearest_others(
    tree: cKDTree, xyz: Float64[np.ndarray, "q 3"], own: Int64[np.ndarray, " q"], k: int
) -> tuple[Float64[np.ndarray, "q k"], Int64[np.ndarray, "q k"]]:
    """The k points of a tree nearest to each query, itself left out.

    Args:
        tree: The tree, of n points.
        xyz: Queries, [q, 3].
        own: Number of the tree's point that a query is, [q]; -1 if it is none of them.
        k: Neighbours per query.

    Returns:
        Distances, nearest first, infinite where the tree has fewer points; and numbers, n there.
    """
    # One for the query itself, and one to see whether another is as far as the k-th.
    distance, number = _others(tree, xyz, own, k + 2)
    tied = np.flatnonzero(_has_ties(distance[:, : k + 1]))
    if len(tied):
        distance[tied, :k], number[tied, :k] = _resolved(tree, xyz[tied], own[tied], k, k + 2)
    return distance[:, :k], number[:, :k]


def _others(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, wanted: int
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest ``wanted - 1`` points other than the query, ties in any order."""
    if (own < 0).all():
        distance, number = tree.query(xyz, wanted - 1)
        return distance, number
    distance, number = tree.query(xyz, wanted)
    # Queries are mostly the first of their own neighbours, but for those at distance 0 beside
    # another that rounding has brought together.
    other = np.flatnonzero(number[:, 0] != own)
    if len(other):
        itself = number[other] == own[other, None]
        place = np.where(itself.any(axis=1), itself.argmax(axis=1), wanted - 1)
        moved = np.arange(wanted) <= place[:, None]
        for values in (distance, number):
            rows = values[other]
            values[other] = np.where(moved, np.roll(rows, 1, axis=1), rows)
    return distance[:, 1:], number[:, 1:]


def _has_ties(distance: np.ndarray) -> np.ndarray:
    """Rows in which two finite distances are equal."""
    equal = (distance[:, 1:] == distance[:, :-1]) & np.isfinite(distance[:, 1:])
    return np.asarray(equal.any(axis=1))


def _resolved(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, k: int, wanted: int
) -> tuple[np.ndarray, np.ndarray]:
    """The k nearest with ties by number: more are fetched until one is farther than the k-th."""
    distance, number = np.empty((len(xyz), k)), np.empty((len(xyz), k), np.int64)
    for start in range(0, len(xyz), max(AT_ONCE // wanted, 1)):
        part = slice(start, start + max(AT_ONCE // wanted, 1))
        found, which = sort_rows(*_others(tree, xyz[part], own[part], wanted))
        distance[part], number[part] = found[:, :k], which[:, :k]
        last = found[:, -1]
        open_ = np.flatnonzero((last == found[:, k - 1]) & np.isfinite(last)) + start
        if len(open_):
            more = min(2 * wanted, tree.n + 2)  # then the last is missing
            distance[open_], number[open_] = _resolved(tree, xyz[open_], own[open_], k, more)
    return distance, number


def sort_rows(
    distance: Float64[np.ndarray, "q m"], number: Int64[np.ndarray, "q m"]
) -> tuple[Float64[np.ndarray, "q m"], Int64[np.ndarray, "q m"]]:
    """Every row by distance, and by number where distances are equal."""
    order = np.lexsort((number, distance), axis=1)
    return np.take_along_axis(distance, order, axis=1), np.take_along_axis(number, order, axis=1)


def distances_of(
    xyz: Float64[np.ndarray, "n 3"], idx: Int32[np.ndarray, "m k"], least: float
) -> Float64[np.ndarray, "m k"]:
    """The distances of the first m rows from their neighbours, at least ``least``, [m, k].

    Computed here and not taken from the tree, so that neighbours that were stored as numbers alone
    get the same distances again.
    """
    distance = np.empty(idx.shape)
    if idx.size > FEW or "numba" in sys.modules:
        from splatseed.upsample.distances import fill_distances  # noqa: PLC0415  (loads Numba)

        fill_distances(xyz, idx, float(least), distance)
        return distance
    for start in range(0, len(idx), ROWS):
        part = slice(start, start + ROWS)
        apart = xyz[idx[part]] - xyz[part][: len(idx[part]), None]
        apart *= apart
        squared = apart[..., 0] + apart[..., 1] + apart[..., 2]
        distance[part] = np.maximum(np.sqrt(squared), least)
    return distance
