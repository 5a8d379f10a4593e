"""A tile with its neighbours: those of its own points, and those of all these neighbours.

Notation: *own* points are the tile's, in leaf order as in memory; the *ring* are points of other
tiles that are neighbours of own ones; the *rim* are neighbours of the ring that are neither.
Promise: neighbours are those of the whole cloud, in its order, whatever the tiles: a point whose k
nearest in its tile reach beyond the tile's walls is looked for in every tile that its ball meets.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32
from scipy.spatial import cKDTree

from splatseed.progress import in_threads, silent
from splatseed.upsample.neighbors import nearest_others, sort_rows
from splatseed.upsample.tiles.cutting import POINT, TileStore

QUERY_BLOCK = 1 << 13
NOBODY = np.iinfo(np.int64).max
"""The row of a neighbour that was not found yet."""
SLACK = 1.0 + 1e-9
"""Distances to walls are widened by this, so that rounding hides nobody."""


def find_neighborhood(
    store: TileStore, tile: int, k: int
) -> tuple[np.ndarray, Int32[np.ndarray, " own"], Int32[np.ndarray, "m k"]]:
    """The k neighbours of the points of a tile, which has some, and of all their neighbours.

    Returns:
        Own points in leaf order, then the ring, then the rim, both in file order, ``POINT``; the
        position in the tile of each own point; and the places among the points of the neighbours of
        own points and of the ring.
    """
    own = store.points(tile)
    tree = cKDTree(own["xyz"], balanced_tree=False)
    order = np.asarray(tree.indices, np.int32)
    points, wide = own[order], order.astype(np.int64)
    distance, position = _query(tree, points["xyz"], wide, k)
    place_of = np.argsort(order).astype(np.int32)
    inner = place_of[np.minimum(position, len(own) - 1)]
    low, high = store.walls[tile]
    x, reach = points["xyz"], distance[:, -1:] * SLACK
    leaves = ((reach >= x - low) | (reach >= high - x)).any(axis=1)  # whose ball meets a wall

    rows = np.append(own["row"], NOBODY)
    row, met = _look_around(store, tile, points[leaves], distance[leaves], rows[position[leaves]])
    ring = _others(row, met, own["row"])
    distance, position = _query(tree, ring["xyz"], np.full(len(ring), -1), k)
    ring_row, more = _look_around(store, tile, ring, distance, rows[position])
    rim = _others(ring_row, [*met, *more], np.concatenate([own["row"], ring["row"]]))
    points = np.concatenate([points, ring, rim])
    by_row = np.argsort(points["row"]).astype(np.int32)
    inner[leaves] = by_row[np.searchsorted(points["row"], row, sorter=by_row)]
    outer = by_row[np.searchsorted(points["row"], ring_row, sorter=by_row)]
    return points, order, np.concatenate([inner, outer])


def _look_around(
    store: TileStore, tile: int, points: np.ndarray, distance: np.ndarray, row: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Look for nearer neighbours in all other tiles that the balls of points meet, near ones first.

    ``distance`` to the k nearest so far, those of ``tile``, is infinite where nobody was found; it
    and ``row``, both [q, k], nearest first, are changed in place. Returned are the rows, and points
    of other tiles that are or were among them.
    """
    k, met, low, high = distance.shape[1], [], store.bounds[:, 0], store.bounds[:, 1]
    xyz = np.ascontiguousarray(points["xyz"].T)  # NumPy is slow along short axes
    gap = np.maximum(np.maximum(low - high[tile], low[tile] - high), 0.0)
    for other in np.argsort((gap**2).sum(axis=1), kind="stable"):
        if other == tile or not store.counts[other]:
            continue
        reach = distance[:, -1] * SLACK  # how far a nearer one could be
        away = np.maximum(low[other, :, None] - xyz, xyz - high[other, :, None])
        who = np.flatnonzero(np.sqrt((np.maximum(away, 0.0) ** 2).sum(axis=0)) <= reach)
        if not len(who):
            continue
        lowest, highest = xyz[:, who] - reach[who], xyz[:, who] + reach[who]
        within = np.stack([lowest.min(axis=1), highest.max(axis=1)])
        others = store.points(int(other), within)
        if not len(others):
            continue
        mine = points["row"][who]
        itself = np.searchsorted(others["row"], mine)
        itself[(itself == len(others)) | (others["row"][itself % len(others)] != mine)] = -1
        tree = cKDTree(others["xyz"], balanced_tree=False)
        found, number = _query(tree, points["xyz"][who], itself, k)
        nearest = sort_rows(
            np.concatenate([distance[who], found], axis=1),
            np.concatenate([row[who], np.append(others["row"], NOBODY)[number]], axis=1),
        )
        distance[who], row[who] = nearest[0][:, :k], nearest[1][:, :k]
        met.append(others[np.isin(others["row"], row[who])])
    return row, met


def _others(wanted: np.ndarray, met: list[np.ndarray], known: np.ndarray) -> np.ndarray:
    """The points of some rows that are not known, in file order; they are among those met."""
    rows = np.setdiff1d(wanted, known)
    pool = np.concatenate([np.empty(0, POINT), *met])
    unique, first = np.unique(pool["row"], return_index=True)
    return pool[first[np.searchsorted(unique, rows)]]


def _query(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """``nearest_others`` on all cores."""
    distance, number = np.empty((len(xyz), k)), np.empty((len(xyz), k), np.int32)

    def query(start: int, stop: int) -> None:
        part = slice(start, stop)
        distance[part], number[part] = nearest_others(tree, xyz[part], own[part], k)

    in_threads(query, len(xyz), QUERY_BLOCK, "neighbours", silent)
    return distance, number
