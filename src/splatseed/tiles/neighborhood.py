"""A tile with its neighbours: those of its own points, and those of all these neighbours.

Notation: *own* points are the tile's, in rows of leaf order as in memory; the *ring* are points of
other tiles that are neighbours of own ones; the *rim* are neighbours of the ring that are neither.
Promise: neighbours are those of the whole cloud, in its order, whatever the tiles: a point whose k
nearest in its tile reach beyond the tile's walls is looked for in every tile that its ball meets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.spatial import cKDTree

from splatseed.progress import in_threads, silent
from splatseed.tiles.store import Points, TileStore
from splatseed.upsample.neighbors import (
    Neighbors,
    PreparedCloud,
    distances_of,
    nearest_others,
    sort_rows,
)

QUERY_BLOCK = 1 << 13
NOBODY = np.iinfo(np.int64).max
"""The rank of a neighbour that was not found yet."""
SLACK = 1.0 + 1e-9
"""Distances to walls are widened by this, so that rounding hides nobody."""


@dataclass(frozen=True, eq=False)
class Neighborhood:
    """A tile's points in rows, those around them, and neighbours.

    Args:
        points: Own points in leaf order, then the ring, then the rim, both by rank.
        num_own: Own points.
        order: Position in the tile of each own row, int32 [num_own].
        idx: Rows of the neighbours of own points and of the ring, int32 [num_own + ring, k].
    """

    points: Points
    num_own: int
    order: Int32[np.ndarray, " own"]
    idx: Int32[np.ndarray, "m k"]


def prepared(store: TileStore, points: Points, num_own: int) -> PreparedCloud:
    """Points as the methods take them."""
    return PreparedCloud(
        points.xyz, points.rgb, points.rank, points.trusted, store.center, None,
        halo=len(points) - num_own,
    )  # fmt: skip


def neighbors_of(store: TileStore, points: Points, idx: Int32[np.ndarray, "m k"]) -> Neighbors:
    """Neighbours with their distances."""
    return Neighbors(idx, distances_of(points.xyz, idx, store.least))


@dataclass(eq=False)
class _Search:
    """The k nearest found so far of some points.

    Args:
        points: The points that search.
        distance: Distances, nearest first, infinite where nobody was found, float64 [q, k].
        rank: Ranks of the neighbours, int64 [q, k].
        met: Points of other tiles that are or were among them.
    """

    points: Points
    distance: Float64[np.ndarray, "q k"]
    rank: Int64[np.ndarray, "q k"]
    met: list[Points]

    @property
    def reach(self) -> Float64[np.ndarray, " q"]:
        """How far a nearer neighbour could be."""
        return np.asarray(self.distance[:, -1] * SLACK)

    def take(self, who: Int64[np.ndarray, " s"], others: Points) -> None:
        """Let some of them see other points."""
        if not len(others):
            return
        k = self.distance.shape[1]
        xyz, rank = self.points.xyz[who], self.points.rank[who]
        tree = cKDTree(others.xyz, balanced_tree=False)
        own = np.searchsorted(others.rank, rank)
        own[(own == len(others)) | (others.rank[own % len(others)] != rank)] = -1
        distance, number = _query(tree, xyz, own, k)
        found = np.append(others.rank, NOBODY)[number]
        nearest = sort_rows(
            np.concatenate([self.distance[who], distance], axis=1),
            np.concatenate([self.rank[who], found], axis=1),
        )
        self.distance[who], self.rank[who] = nearest[0][:, :k], nearest[1][:, :k]
        seen = np.isin(others.rank, self.rank[who])
        self.met.append(others.select(seen))


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
    row_of = np.empty(len(own), np.int32)
    row_of[order] = np.arange(len(own), dtype=np.int32)
    reach, inner = _in_tile(tree, own, order, row_of, k)
    open_ = _beyond_walls(own.xyz[order], reach, store.walls[tile])
    search = _start(tree, own, own.select(order[open_]), order[open_], k)
    _search_tiles(store, search, tile)
    ring = _others(own, search.met, search.rank, own)
    further = _start(tree, own, ring, np.full(len(ring), -1), k)
    _search_tiles(store, further, tile)
    rim = _others(own, [*search.met, *further.met], further.rank, own, ring)
    idx = np.empty((len(own) + len(ring), k), np.int32)
    idx[: len(own)] = inner
    idx[open_] = _rows(search.rank, own, row_of, ring, rim)
    idx[len(own) :] = _rows(further.rank, own, row_of, ring, rim)
    parts = [own.select(order), ring, rim]
    points = Points(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("xyz", "rgb", "rank", "trusted"))
    )
    return Neighborhood(points, len(own), order, idx)


def _query(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """``nearest_others`` on all cores."""
    if len(xyz) <= QUERY_BLOCK:
        return nearest_others(tree, xyz, own, k)
    distance, number = np.empty((len(xyz), k)), np.empty((len(xyz), k), np.int64)

    def query(start: int, stop: int) -> None:
        part = slice(start, stop)
        distance[part], number[part] = nearest_others(tree, xyz[part], own[part], k)

    in_threads(query, len(xyz), QUERY_BLOCK, "neighbours", silent)
    return distance, number


def _in_tile(
    tree: cKDTree, own: Points, order: np.ndarray, row_of: np.ndarray, k: int
) -> tuple[Float64[np.ndarray, " n"], Int32[np.ndarray, "n k"]]:
    """How far the k-th neighbour in the tile is from each row, and the rows of all k.

    Where there are fewer, the distance is infinite, and the others are any rows.
    """
    reach, rows = np.empty(len(own)), np.empty((len(own), k), np.int32)

    def query(start: int, stop: int) -> None:
        part = order[start:stop].astype(np.int64)
        distance, position = nearest_others(tree, own.xyz[part], part, k)
        reach[start:stop] = distance[:, -1]
        rows[start:stop] = row_of[np.minimum(position, len(own) - 1)]

    in_threads(query, len(own), QUERY_BLOCK, "neighbours", silent)
    return reach, rows


def _beyond_walls(
    xyz: Float64[np.ndarray, "n 3"],
    reach: Float64[np.ndarray, " n"],
    walls: Float64[np.ndarray, "2 3"],
) -> Int64[np.ndarray, " open"]:
    """The points whose ball reaches a wall of the tile."""
    near = np.zeros(len(xyz), bool)
    for axis in range(3):  # column by column: NumPy is slow along short axes
        near |= reach * SLACK >= xyz[:, axis] - walls[0, axis]
        near |= reach * SLACK >= walls[1, axis] - xyz[:, axis]
    return np.flatnonzero(near)


def _start(tree: cKDTree, among: Points, own: Points, who: np.ndarray, k: int) -> _Search:
    """A search that begins with the neighbours in the tile.

    Args:
        tree: The tree over the tile's points.
        among: These points.
        own: The points that search.
        who: Their positions in the tile, -1 if they are of another.
        k: Neighbours of each.
    """
    distance, number = _query(tree, own.xyz, np.asarray(who, np.int64), k)
    return _Search(own, distance, np.append(among.rank, NOBODY)[number], [])


def _search_tiles(store: TileStore, search: _Search, tile: int) -> None:
    """Look in all tiles but one that the balls of the searching points meet, near ones first."""
    if not len(search.points):
        return
    middle = store.bounds[tile]
    gap = _gap(store.bounds[:, 0], store.bounds[:, 1], middle)
    for other in np.argsort(gap, kind="stable"):
        if other == tile or not store.counts[other]:
            continue
        bounds, reach = store.bounds[other], search.reach
        xyz = search.points.xyz
        squared = np.zeros(len(xyz))
        for axis in range(3):
            x = xyz[:, axis]
            squared += np.maximum(np.maximum(bounds[0, axis] - x, x - bounds[1, axis]), 0.0) ** 2
        who = np.flatnonzero(np.sqrt(squared) <= reach)
        if not len(who):
            continue
        ball = reach[who, None]
        within = np.stack([(xyz[who] - ball).min(axis=0), (xyz[who] + ball).max(axis=0)])
        search.take(who, store.points(int(other), within))


def _gap(
    low: Float64[np.ndarray, "t 3"], high: Float64[np.ndarray, "t 3"], box: np.ndarray
) -> Float64[np.ndarray, " t"]:
    """The distance of each box from one; infinite for tiles without points."""
    away = np.maximum(np.maximum(low - box[1], box[0] - high), 0.0)
    return np.asarray(np.nan_to_num(np.sqrt((away**2).sum(axis=1)), nan=np.inf))


def _others(
    own: Points, met: list[Points], wanted: Int64[np.ndarray, "q k"], *known: Points
) -> Points:
    """The points of some ranks that are not known yet, by rank; they are among those met."""
    ranks = np.unique(wanted)
    for points in known:
        ranks = ranks[~_among(points.rank, ranks)[1]]
    pool = Points.union([own.select(np.arange(0)), *met])
    return pool.select(np.searchsorted(pool.rank, ranks))


def _among(
    ordered: Int64[np.ndarray, " n"], rank: Int64[np.ndarray, "..."]
) -> tuple[Int64[np.ndarray, "..."], Bool[np.ndarray, "..."]]:
    """The places of some ranks among ascending ones, and whether they are there."""
    if not len(ordered):
        return np.zeros(rank.shape, np.int64), np.zeros(rank.shape, bool)
    place = np.minimum(np.searchsorted(ordered, rank), len(ordered) - 1)
    return place, ordered[place] == rank


def _rows(
    rank: Int64[np.ndarray, "q k"],
    own: Points,
    row_of: Int32[np.ndarray, " n"],
    ring: Points,
    rim: Points,
) -> Int32[np.ndarray, "q k"]:
    """The rows of some ranks."""
    rows = np.empty(rank.shape, np.int32)
    first = 0
    for points in (own, ring, rim):
        place, there = _among(points.rank, rank)
        rows[there] = row_of[place[there]] if points is own else first + place[there]
        first += len(points)
    return rows
