"""The work on one tile: weighing its points as bases, and making their new points.

Between the two the bases are drawn (``drawing``), from the weights of all tiles. What the first
finds, the second needs: neighbours are kept on disk as rows, a tenth of the time of finding them.
Promise: both are the method's own ``weigh`` and ``place``, and depend on nothing but the folder, so
that they can run in any process, on any machine that sees it, in any order, and twice.
"""

from __future__ import annotations

import numpy as np

from splatseed.errors import PointCloudError
from splatseed.progress import silent
from splatseed.tiles.neighborhood import find_neighborhood, neighbors_of, prepared
from splatseed.tiles.splitting import tile_name
from splatseed.tiles.store import Points, TileStore
from splatseed.tiles.stream import TileDraws
from splatseed.tiles.work import WorkFolder
from splatseed.upsample.method import NewPoints
from splatseed.upsample.nearest import NearestMethod
from splatseed.upsample.neighbors import Bases

KNOWN = "known_"
"""Begins the names of arrays that the method has found."""


def weighed_name(tile: int) -> str:
    """The folder of a weighed tile."""
    return f"weighed/{tile_name(tile)}"


def made_name(tile: int) -> str:
    """The folder of a tile's new points."""
    return f"made/{tile_name(tile)}"


def weigh_tile(work: WorkFolder, method: NearestMethod, tile: int) -> None:
    """Find the neighbours of a tile's points, and how likely each is a base.

    Saved are ``weight`` float64 [n] by position; and for ``place_tile`` the ``order`` of rows, the
    rows of neighbours ``idx`` int32 [n, k], the ring, and what the method has found.

    Args:
        work: The folder, in which the rows are split.
        method: The method.
        tile: The tile, which has points.
    """
    store = TileStore(work)
    k = min(method.num_queried, store.count - 1)
    around = find_neighborhood(store, tile, k)
    cloud = prepared(store, around.points, around.num_own)
    neighbors = neighbors_of(store, around.points, around.idx)
    weight, known = method.weigh(cloud, neighbors, silent)
    by_position = np.empty(around.num_own)
    by_position[around.order] = weight
    idx, last = around.idx[: around.num_own, : method.num_neighbors], len(around.idx)
    ring = around.points.select(np.arange(around.num_own, last))
    work.save(
        weighed_name(tile),
        {
            "weight": by_position,
            "order": around.order,
            "idx": idx,
            **{f"ring_{name}": getattr(ring, name) for name in ("xyz", "rgb", "rank", "trusted")},
            **{f"{KNOWN}{name}": values for name, values in known.items()},
        },
    )


def place_tile(work: WorkFolder, method: NearestMethod, tile: int) -> None:
    """Make the new points of a tile's bases.

    Saved are ``start`` int64 [b] and ``count`` int32 [b] of the bases that make any, in file order,
    and their points' ``xyz`` float32 [m, 3] and ``rgb`` uint8 [m, 3].

    Args:
        work: The folder, in which the bases are drawn.
        method: The method.
        tile: The tile, which has points.

    Raises:
        PointCloudError: A new point is not finite.
    """
    store, drawn = TileStore(work), work.facts("drawn") or {}
    start, count = (_drawn(work, tile, each) for each in ("start", "count"))
    makes = np.flatnonzero(count)
    cloud_points, idx, order = _rows(work, store, tile)
    cloud = prepared(store, cloud_points, len(order))
    neighbors = neighbors_of(store, cloud_points, idx)
    bases = _bases(count, order)
    draws = TileDraws(drawn["stream"], drawn["total"], start[makes], count[makes].astype(np.int64))
    known = {
        name.removeprefix(KNOWN): work.load(weighed_name(tile), name)
        for name in work.keys(weighed_name(tile))
        if name.startswith(KNOWN)
    }
    new = method.place(cloud, neighbors, known, bases, draws, silent)
    _check_finite(new)
    arrays = {"start": start[makes], "count": count[makes], "xyz": new.xyz, "rgb": new.rgb}
    work.save(made_name(tile), arrays)


def _drawn(work: WorkFolder, tile: int, name: str) -> np.ndarray:
    dtype = {"start": "<i8", "count": "<i4"}[name]
    return np.fromfile(work.file(f"drawn/{tile_name(tile)}.{name}"), dtype)


def _rows(work: WorkFolder, store: TileStore, tile: int) -> tuple[Points, np.ndarray, np.ndarray]:
    """A weighed tile's points in rows, the rows of neighbours, and the order of own rows."""
    order, idx = (work.load(weighed_name(tile), name) for name in ("order", "idx"))
    ring = Points(
        *(work.load(weighed_name(tile), f"ring_{n}") for n in ("xyz", "rgb", "rank", "trusted"))
    )
    own = store.points(tile).select(order)
    arrays = (
        np.concatenate([getattr(part, name) for part in (own, ring)])
        for name in ("xyz", "rgb", "rank", "trusted")
    )
    return Points(*arrays), idx, order


def _bases(count: np.ndarray, order: np.ndarray) -> Bases:
    """The tile's new points, laid out by position, for its rows."""
    wide = count.astype(np.int64)
    start = np.cumsum(wide) - wide
    return Bases(start[order], wide[order], int(wide.sum()))


def _check_finite(new: NewPoints) -> None:
    if not np.isfinite(new.xyz).all():
        raise PointCloudError(
            "finite new points",
            found="one that is not",
            fix="Report this with the cloud; float32 may be too small for its coordinates.",
        )
