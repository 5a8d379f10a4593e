"""A tile with its neighbours: those of its own points, and those of all these neighbours.

Notation: *own* points are the tile's, in leaf order as in memory; the *ring* are points of other
tiles that are neighbours of own ones; the *rim* are neighbours of the ring that are neither.
Promise: neighbours are those of the whole cloud, in its order, whatever the tiles: a point whose k
nearest in its tile reach beyond the tile's walls is looked for in every tile that its ball meets.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.spatial import cKDTree

from splatseed.progress import in_threads, silent
from splatseed.tiles.cutting import Points, TileStore
from splatseed.upsample.neighbors import nearest_others, sort_rows

QUERY_BLOCK = 1 << 13
NOBODY = np.iinfo(np.int64).max
"""The row of a neighbour that was not found yet."""
SLACK = 1.0 + 1e-9
"""Distances to walls are widened by this, so that rounding hides nobody."""


@dataclass(frozen=True, eq=False)
class Neighborhood:
    """A tile's points, those around them, and neighbours.

    Args:
        points: Own points in leaf order, then the ring, then the rim, both in file order.
        num_own: Own points.
        order: Position in the tile of each own point, int32 [num_own].
        idx: Places in ``points`` of the neighbours of own points and of the ring, int32
            [num_own + ring, k].
    """

    points: Points
    num_own: int
    order: Int32[np.ndarray, " own"]
    idx: Int32[np.ndarray, "m k"]


@dataclass(eq=False)
class _Search:
    """The k nearest found so far of some points.

    Args:
        points: The points that search.
        distance: Distances, nearest first, infinite where nobody was found, float64 [q, k].
        row: Rows of the neighbours, int64 [q, k].
        met: Points of other tiles that are or were among them.
    """

    points: Points
    distance: Float64[np.ndarray, "q k"]
    row: Int64[np.ndarray, "q k"]
    met: list[Points] = field(default_factory=list)

    def take(self, who: Int64[np.ndarray, " s"], others: Points) -> None:
        """Let some of them see other points."""
        if not len(others):
            return
        k = self.distance.shape[1]
        row = self.points.row[who]
        own = np.searchsorted(others.row, row)
        own[(own == len(others)) | (others.row[own % len(others)] != row)] = -1
        tree = cKDTree(others.xyz, balanced_tree=False)
        distance, number = _query(tree, self.points.xyz[who], own, k)
        nearest = sort_rows(
            np.concatenate([self.distance[who], distance], axis=1),
            np.concatenate([self.row[who], np.append(others.row, NOBODY)[number]], axis=1),
        )
        self.distance[who], self.row[who] = nearest[0][:, :k], nearest[1][:, :k]
        self.met.append(others.select(np.isin(others.row, self.row[who])))

    def look_around(self, store: TileStore, tile: int) -> None:
        """Look in all tiles but one that the balls of the points meet, near ones first."""
        low, high = store.bounds[:, 0], store.bounds[:, 1]
        gap = np.maximum(np.maximum(low - high[tile], low[tile] - high), 0.0)
        xyz = self.points.xyz
        for other in np.argsort((gap**2).sum(axis=1), kind="stable"):
            if other == tile or not store.counts[other]:
                continue
            reach = self.distance[:, -1] * SLACK  # how far a nearer one could be
            squared = np.zeros(len(xyz))
            for axis in range(3):  # column by column: NumPy is slow along short axes
                x = xyz[:, axis]
                away = np.maximum(low[other, axis] - x, x - high[other, axis])
                squared += np.maximum(away, 0.0) ** 2
            who = np.flatnonzero(np.sqrt(squared) <= reach)
            if len(who):
                ball = reach[who, None]
                within = np.stack([(xyz[who] - ball).min(axis=0), (xyz[who] + ball).max(axis=0)])
                self.take(who, store.points(int(other), within))


def find_neighborhood(store: TileStore, tile: int, k: int) -> Neighborhood:
    """The neighbours of a tile's points and of all their neighbours.

    Args:
        store: The tiles.
        tile: The tile, which has points.
        k: Neighbours of each; the cloud has more points than that.
    """
    own = store.points(tile)
    tree = cKDTree(own.xyz, balanced_tree=False)
    order = np.asarray(tree.indices, np.int32)
    place_of = np.empty(len(own), np.int32)
    place_of[order] = np.arange(len(own), dtype=np.int32)
    reach, inner = np.empty(len(own)), np.empty((len(own), k), np.int32)

    def query(start: int, stop: int) -> None:
        part = order[start:stop].astype(np.int64)
        distance, position = nearest_others(tree, own.xyz[part], part, k)
        reach[start:stop] = distance[:, -1] * SLACK
        inner[start:stop] = place_of[np.minimum(position, len(own) - 1)]

    in_threads(query, len(own), QUERY_BLOCK, "neighbours", silent)
    leaves = np.zeros(len(own), bool)  # those whose ball reaches a wall of the tile
    for axis in range(3):
        x = own.xyz[order, axis]
        leaves |= (reach >= x - store.walls[tile, 0, axis]) | (
            reach >= store.walls[tile, 1, axis] - x
        )

    def search(points: Points, positions: np.ndarray) -> _Search:
        distance, number = _query(tree, points.xyz, positions.astype(np.int64), k)
        started = _Search(points, distance, np.append(own.row, NOBODY)[number])
        started.look_around(store, tile)
        return started

    def others(wanted: np.ndarray, met: list[Points], *known: Points) -> Points:
        """The points of some rows that are not known, in file order; they are among those met."""
        rows = np.setdiff1d(wanted, np.concatenate([each.row for each in known]))
        pool = Points.joined(own.select(np.arange(0)), *met)
        unique, first = np.unique(pool.row, return_index=True)
        return pool.select(first[np.searchsorted(unique, rows)])

    positions = order[leaves]
    first = search(own.select(positions), positions)
    ring = others(first.row, first.met, own)
    second = search(ring, np.full(len(ring), -1))
    rim = others(second.row, [*first.met, *second.met], own, ring)
    points = Points.joined(own.select(order), ring, rim)
    by_row = np.argsort(points.row)
    inner[leaves] = by_row[np.searchsorted(points.row, first.row, sorter=by_row)]
    outer = by_row[np.searchsorted(points.row, second.row, sorter=by_row)].astype(np.int32)
    return Neighborhood(points, len(own), order, np.concatenate([inner, outer]))


def _query(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """``nearest_others`` on all cores."""
    distance, number = np.empty((len(xyz), k)), np.empty((len(xyz), k), np.int64)

    def query(start: int, stop: int) -> None:
        part = slice(start, stop)
        distance[part], number[part] = nearest_others(tree, xyz[part], own[part], k)

    in_threads(query, len(xyz), QUERY_BLOCK, "neighbours", silent)
    return distance, number
