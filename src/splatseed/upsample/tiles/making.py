"""A cloud in tiles, from the first row to the last new point: the steps in their order.

Bases are drawn in file order, as in memory, from the weights of all tiles. Because each tile keeps
its points in file order, the points of a run of rows are the next ones of every tile, so that all
files are read and written from front to back. Promise: a finished step is not done again after a
kill; ``weigh`` and ``place`` depend on nothing but the folder, so that they can run in any process,
on any machine that sees it, in any order, and twice; the points are those of
``splatseed.upsample.upsample``, byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from splatseed.errors import ParameterError, PointCloudError
from splatseed.io.staging import remove, staged
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks, silent
from splatseed.runtime.tasks import Tasks
from splatseed.upsample import neighbors
from splatseed.upsample.method import Upsampler
from splatseed.upsample.methods.bounding_box import BoundingBox, in_box
from splatseed.upsample.nearest import NearestMethod
from splatseed.upsample.tiles.cutting import (
    Rows,
    Source,
    TileStore,
    append_by_tile,
    by_tile,
    read_rows,
    split,
    tile_name,
)
from splatseed.upsample.tiles.neighborhood import find_neighborhood
from splatseed.upsample.tiles.work import TilePlan, facts_of, finish, load_arrays, save_arrays

Piece: TypeAlias = tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]
"""Positions and colours of some points."""

DRAWN = np.dtype([("start", "<i8"), ("count", "<i4")])
"""The first new point of a base, and how many it makes."""
PLACED = np.dtype([("xyz", "<f4", 3), ("number", "<i8")])
"""A point and its number in the output."""
KNOWN = "known_"
"""Begins the names of arrays that the method has found."""
HASH = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint64)
STREAM_BLOCK = 1 << 14
"""New points whose random numbers are drawn at a time."""


@dataclass(frozen=True)
class Request:
    """What to make."""

    name: str  # the method's
    method: Upsampler
    ratio: float | None = None  # points in all, as a multiple of the originals
    num_points: int | None = None  # points in all, instead
    seed: int = 0

    def job(self, source: Source) -> dict[str, object]:
        """All that determines the result, as JSON has it."""
        return {
            "input": dict(source.fingerprint),
            "method": self.name,
            "parameters": asdict(self.method),  # type: ignore[call-overload]  # a method is a dataclass
            "ratio": self.ratio,
            "num_points": self.num_points,
            "seed": self.seed,
            "version": version("splatseed"),
        }


@dataclass(frozen=True)
class Tiled:
    """Points that lie in a folder."""

    work: Path
    num_original: int
    num_new: int
    non_finite: int  # rows that were left out because a coordinate is not finite
    repeats: int  # rows that were left out because they repeat a position
    origin: tuple[float, float, float]  # what was subtracted from all positions
    tiles: int
    at_once: int  # points to give at a time
    request: Request

    def originals(self, progress: Progress) -> Iterator[Piece]:
        """The originals, in file order."""
        rows = Rows(self.work)
        for first, last in blocks(rows.count, self.at_once, "write", progress):
            cloud = rows.cloud(first, last)
            kept = rows.tiles(first, last) >= 0
            yield cloud.xyz[kept], cloud.rgb[kept]

    def new(self, progress: Progress) -> Iterator[Piece]:
        """The new points, in the order in which they were drawn."""
        if isinstance(self.request.method, BoundingBox):
            yield from self._in_box(progress)
            return
        tiles = np.flatnonzero(TileStore(self.work).counts)
        for first, last in blocks(self.num_new, self.at_once, "write", progress):
            xyz = np.empty((last - first, 3), np.float32)
            rgb = np.empty((last - first, 3), np.uint8)
            for tile in tiles:
                made = load_arrays(self.work / "made" / tile_name(tile))
                part = slice(*np.searchsorted(made["number"], [first, last]))
                places = made["number"][part] - first
                xyz[places], rgb[places] = made["xyz"][part], made["rgb"][part]
            yield xyz, rgb

    def _in_box(self, progress: Progress) -> Iterator[Piece]:
        """The points of ``random``, with all colours in memory.

        In memory, the positions of all M new points are drawn first, then their colours; here one
        generator draws positions, and another, 3 M numbers ahead, colours.
        """
        store = TileStore(self.work)
        colors = np.concatenate([rgb for _, rgb in self.originals(silent)])
        low, high = np.nanmin(store.bounds[:, 0], axis=0), np.nanmax(store.bounds[:, 1], axis=0)
        places = np.random.default_rng(self.request.seed)
        picks = _ahead(places.bit_generator.state, 3 * self.num_new)
        for first, last in blocks(self.num_new, self.at_once, "write", progress):
            xyz = places.random((last - first, 3), dtype=np.float32)
            xyz[...] = in_box(xyz, low, high, store.center)
            yield xyz, colors[picks.integers(0, store.count, last - first, dtype=np.int32)]

    @property
    def num_repeated(self) -> int:
        """New points that repeat a position, which scenes are written without."""
        return int(facts_of(self.work, "repeats").get("count", 0))

    def new_distinct(self, progress: Progress) -> Iterator[Piece]:
        """The new points but for those."""
        first = 0
        for xyz, rgb in self.new(progress):
            kept = np.ones(len(xyz), bool)
            if self.num_repeated:
                kept = ~np.fromfile(self.work / "repeated", bool, len(xyz), offset=first)
            first += len(xyz)
            yield xyz[kept], rgb[kept]


def make_tiled(
    work: Path, source: Source, request: Request, plan: TilePlan, tasks: Tasks, progress: Progress
) -> Tiled:
    """Make the new points of a cloud, tile by tile, by ``random`` or a ``NearestMethod`` that can.

    Args:
        work: The folder, which may hold finished steps of the same job.
        source: The cloud.
        request: What to make.
        plan: The size of tiles.
        tasks: What carries out the work on tiles.
        progress: Told the stages.

    Raises:
        ParameterError: The number of points is out of range.
        PointCloudError: Too few distinct finite points for the method.
        OutputError: The disk is full.
    """
    from splatseed.upsample import planned_size  # noqa: PLC0415  (the package that this is in)

    if not facts_of(work, "read"):
        read_rows(work, source, plan.at_once, progress)
    if not facts_of(work, "split"):
        split(work, source, plan.tile_points, plan.at_once, progress)
    facts, store = facts_of(work, "split"), TileStore(work)
    if facts["most"] > plan.tile_points and store.counts.max() > plan.tile_points:
        raise ParameterError(
            f"memory for tiles of {facts['most']:,} points, as they were cut",
            found=f"enough for {plan.tile_points:,}",
            fix=f"Pass the --memory of the first time, or remove {work} to begin anew.",
        )
    try:
        num_new = planned_size(store.count, request.ratio, request.num_points) - store.count
    except ParameterError:  # no command can go on from here
        remove(work)
        raise
    tiled = Tiled(
        work, store.count, num_new, facts["non_finite"], facts["repeats"],
        tuple(Rows(work).origin.tolist()), len(store.counts), plan.at_once, request,
    )  # fmt: skip
    method = request.method
    if not num_new or not isinstance(method, NearestMethod):
        return tiled
    method.check_enough(store.count)
    tiles = [tile_name(tile) for tile in np.flatnonzero(store.counts)]
    if not facts_of(work, "drawn"):
        left = [(work, method, each) for each in tiles if not (work / "weighed" / each).exists()]
        tasks.run_all(weigh, left, "neighbours", progress)
        _draw(work, num_new, request.seed, progress)
    left = [(work, method, each) for each in tiles if not (work / "made" / each).exists()]
    tasks.run_all(place, left, "new points", progress)
    if not facts_of(work, "repeats"):
        _find_repeats(tiled, plan.tile_points, progress)
    for name in ("tiles", "weighed", "drawn"):  # the output needs the space
        remove(work / name)
    return tiled


def weigh(work: Path, method: NearestMethod, tile: str) -> None:
    """Find the neighbours of a tile's points, and how likely each is a base, as a task.

    Saved are ``weight`` float64 [n] by position; and for ``place`` the ``order`` of own points, the
    places of neighbours ``idx`` int32 [n, k], the ``ring``, and what the method has found.
    """
    store = TileStore(work)
    k = min(method.num_queried, store.count - 1)
    points, order, idx = find_neighborhood(store, int(tile), k)
    weight, known = method.weigh(*_prepared(store, points, len(order), idx), silent)
    by_position = np.empty(len(order))
    by_position[order] = weight
    save_arrays(work / "weighed" / tile, {
        "weight": by_position, "order": order, "idx": idx[: len(order), : method.num_neighbors],
        "ring": points[len(order) : len(idx)],
        **{f"{KNOWN}{name}": values for name, values in known.items()},
    })  # fmt: skip


def _prepared(
    store: TileStore, points: np.ndarray, num_own: int, idx: Int32[np.ndarray, "m k"]
) -> tuple[neighbors.PreparedCloud, neighbors.Neighbors]:
    """Points and their neighbours as the methods take them."""
    xyz, rgb, row, trusted = (points[name].copy() for name in ("xyz", "rgb", "row", "trusted"))
    halo = len(points) - num_own
    cloud = neighbors.PreparedCloud(xyz, rgb, row, trusted, store.center, None, halo=halo)
    return cloud, neighbors.Neighbors(idx, neighbors.distances_of(cloud.xyz, idx, store.least))


def _draw(work: Path, num_new: int, seed: int, progress: Progress) -> None:
    """Draw the bases of all new points as ``draw_bases`` does: ``drawn/NNNNNN`` by position."""
    store, rng = TileStore(work), np.random.default_rng(seed)
    sums = np.array([weight.sum() for _, weight in _weights(store, progress)])
    alike = not sums.any()  # no weight at all: every point is as likely as any other
    if alike:
        sums = np.array([float(len(tiles)) for tiles, _ in _weights(store, progress)])
    totals, first = neighbors.draw_blocks(sums, num_new, rng), 0
    with staged(work / "drawn", folder=True) as folder:
        for total, (tiles, weight) in zip(totals, _weights(store, progress), strict=True):
            counts = neighbors.draw_in_block(np.ones_like(weight) if alike else weight, total, rng)
            drawn = np.empty(len(counts), DRAWN)
            drawn["start"], drawn["count"] = first + np.cumsum(counts) - counts, counts
            first += int(total)
            append_by_tile(folder, tiles, drawn)
    state: Any = rng.bit_generator.state
    assert not state["has_uint32"]  # noqa: S101  (drawing bases takes whole numbers)
    stream = {name: str(value) for name, value in state["state"].items()}  # of 128 bits
    finish(work, "drawn", {"total": num_new, "stream": stream})


def _weights(
    store: TileStore, progress: Progress
) -> Iterator[tuple[Int32[np.ndarray, " b"], Float64[np.ndarray, " b"]]]:
    """The tiles and the weights of each block of points in file order, without dropped rows."""
    rows, size, taken = Rows(store.work), neighbors.DRAW_BLOCK, np.zeros_like(store.counts)
    left = np.empty(0, np.int32)
    for first, last in blocks(rows.count, size, "draw", progress):
        tiles = rows.tiles(first, last)
        left = np.concatenate([left, tiles[tiles >= 0]])
        while len(left) >= size or (len(left) and last == rows.count):
            tiles, left = left[:size], left[size:]
            weight = np.empty(len(tiles))
            for tile, places in by_tile(tiles):
                path = store.work / "weighed" / tile_name(tile) / "weight.npy"
                part = slice(taken[tile], taken[tile] + len(places))
                weight[places] = np.load(path, mmap_mode="r")[part]
                taken[tile] += len(places)
            yield tiles, weight


def place(work: Path, method: NearestMethod, tile: str) -> None:
    """Make the new points of a tile's bases, as a task; what weighing left is then removed.

    Saved are the new points' ``number`` int64 [m], ascending, ``xyz`` float32 [m, 3] and ``rgb``
    uint8 [m, 3].
    """
    store, drawn = TileStore(work), facts_of(work, "drawn")
    weighed, bases = load_arrays(work / "weighed" / tile), np.fromfile(work / "drawn" / tile, DRAWN)
    order = weighed["order"]
    points = np.concatenate([store.points(int(tile))[order], weighed["ring"]])
    cloud, near = _prepared(store, points, len(order), np.array(weighed["idx"]))
    count = bases["count"].astype(np.int64)
    first = np.cumsum(count) - count
    number = np.repeat(bases["start"] - first, count) + np.arange(count.sum())
    found = [key for key in weighed if key.startswith(KNOWN)]
    known = {key.removeprefix(KNOWN): np.array(weighed[key]) for key in found}
    own = neighbors.Bases(first[order], count[order], len(number))
    draws = TileDraws(drawn["stream"], drawn["total"], number)
    new = method.place(cloud, near, known, own, draws, silent)
    if not np.isfinite(new.xyz).all():
        raise PointCloudError(
            "finite new points",
            found="one that is not",
            fix="Report this with the cloud; float32 may be too small for its coordinates.",
        )
    save_arrays(work / "made" / tile, {"number": number, "xyz": new.xyz, "rgb": new.rgb})
    remove(work / "weighed" / tile)


class TileDraws:
    """Draws for a tile's new points; stands in for a generator in ``place``.

    In memory, a method draws ``rng.random((M, c), dtype=float32)``, a row for each of the M new
    points; here those rows of the same stream that belong to the tile, whose points have the
    numbers ``number``. ``stream`` is where NumPy's PCG64 is when the first new point of all draws.
    """

    def __init__(self, stream: dict[str, str], total: int, number: Int64[np.ndarray, " m"]) -> None:
        known = {name: int(value) for name, value in stream.items()}
        self._state = {"bit_generator": "PCG64", "state": known, "has_uint32": 0, "uinteger": 0}
        self._total, self._number, self._drawn = total, number, 0

    def random(self, size: Any, dtype: Any) -> Float32[np.ndarray, "..."]:
        """What the whole draw gives the tile's new points, float32 [m] or [m, c]."""
        assert dtype == np.float32  # noqa: S101  (other types take another number of bits)
        shape = (size,) if isinstance(size, int | np.integer) else tuple(size)
        columns = int(np.prod(shape[1:], dtype=np.int64))
        out = np.empty((shape[0], columns), np.float32)
        block = self._number // STREAM_BLOCK
        edges = np.flatnonzero(np.diff(block, prepend=-1, append=-1))
        for first, last in pairwise(edges):  # the others are skipped
            begin = int(self._number[first])
            rng = _ahead(self._state, self._drawn + begin * columns)
            some = rng.random((int(self._number[last - 1]) + 1 - begin, columns), dtype=np.float32)
            out[first:last] = some[self._number[first:last] - begin]
        self._drawn += self._total * columns
        return out.reshape(shape)


def _ahead(state: Any, floats: int) -> np.random.Generator:
    """A generator after so many float32, of which every 64-bit number gives two."""
    bits = np.random.PCG64()
    bits.state = state
    bits.advance(floats // 2)
    rng = np.random.Generator(bits)
    if floats % 2:
        rng.random(dtype=np.float32)
    return rng


def _find_repeats(tiled: Tiled, most: int, progress: Progress) -> None:
    """Flag new points that repeat a position in ``repeated``, a byte each.

    Rounding to float32 can put two points of dense clouds in one place; of equal ones the first
    stays, as ``PointCloud.distinct`` has it. Points are sorted by a hash of their position into
    files of about ``most`` points.
    """
    work, total = tiled.work, tiled.num_original + tiled.num_new
    buckets, first, count = -(-total // most), 0, 0
    with (
        staged(work / "repeated", folder=False) as flags,
        staged(work / "positions", folder=True) as folder,
    ):
        with flags.open("wb") as file:
            file.truncate(tiled.num_new)

        def keep_first(points: np.ndarray) -> Bool[np.ndarray, " n"]:
            nonlocal count
            kept = PointCloud(points["xyz"], np.zeros((len(points), 3), np.uint8)).distinct
            again = points["number"][~kept] - tiled.num_original
            if len(again):  # mapped anew each time, so that pages are let go
                np.memmap(flags, np.uint8, "r+")[again] = 1
            count += len(again)
            return kept

        for xyz, _ in chain(tiled.originals(silent), tiled.new(silent)):
            points = np.empty(len(xyz), PLACED)
            points["xyz"], points["number"] = xyz, np.arange(first, first + len(xyz))
            first += len(xyz)
            progress("repeats", first / total / 2)
            points = points[keep_first(points)]
            bits = (points["xyz"] + np.float32(0)).view(np.uint32)  # -0.0 equals 0.0
            mixed = bits.astype(np.uint64) @ HASH
            append_by_tile(folder, (mixed >> np.uint64(7)) % np.uint64(buckets), points)
        for bucket in range(buckets):
            if (path := folder / tile_name(bucket)).exists():
                keep_first(np.fromfile(path, PLACED))
            progress("repeats", 0.5 + (bucket + 1) / buckets / 2)
    remove(work / "positions")
    finish(work, "repeats", {"count": count})
