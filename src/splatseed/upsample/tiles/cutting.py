"""The cloud on disk: copied as it is, then sorted into tiles.

Notation: a *row* is a point as the input has it, also one that is not finite or repeats another; a
*tile* is a box of a kd-tree of a sample of the rows, with *walls* (which may be infinite) and the
*bounds* of its points. ``rows`` holds all rows, ``tile_of_row`` int32 the tile of each, -1 where it
drops out, and ``tiles/NNNNNN`` the points of a tile in file order. Promise: what is kept, its order
and its centroid are those of the cloud in memory; coordinates keep the precision of the input;
every point is in exactly one tile.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from scipy.spatial import cKDTree

from splatseed.errors import OutputError, ParameterError
from splatseed.io.clouds import CloudChunk, CloudFile
from splatseed.io.seeds import number_of_originals
from splatseed.io.staging import staged
from splatseed.pointcloud import FARTHEST, PointCloud
from splatseed.progress import Progress, blocks
from splatseed.scene import Scene
from splatseed.upsample.method import nothing_finite
from splatseed.upsample.neighbors import least_distance, trusted_originals
from splatseed.upsample.tiles.work import facts_of, finish

ROW = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
RECORD = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("trusted", "?"), ("row", "<i8")])
"""A point of a tile."""
POINT = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3), ("trusted", "?"), ("row", "<i8")])
"""The same relative to the centroid: colour, whether it may be a base, and row."""
GREY = 128
"""The colour of points without one."""
SAMPLE = 1 << 20
"""Rows, at most twice as many, that the cuts are made by."""
FAR_OFF = 8.0
"""Coordinates farther from zero than this many extents of the cloud lose precision in float32."""
MARGIN, SMALLER, TRIES = 0.85, 0.7, 8
"""A sample tells the points of a tile only nearly: the share of the most that is aimed at, the
factor to it after each try that fails, and the tries."""


@dataclass(frozen=True, eq=False)
class Source:
    """Points that may be too many for memory, in the order of the cloud in memory."""

    chunks: Callable[[int], Iterator[CloudChunk]]  # gives at most so many at a time
    count: int | None  # None if only reading tells
    fingerprint: Mapping[str, object]  # what tells one input from another, as JSON has it
    scene: Scene  # whose originals they are; an empty one around points of a file
    path: Path | None = None  # that file
    trusted: Bool[np.ndarray, " n"] | None = None  # which of them may be bases; None if all may
    held: int = 0  # bytes that they keep in memory


def file_source(cloud: CloudFile) -> Source:
    """The originals in a file, which its name, size and modification time identify."""
    path, count = cloud.path.resolve(), cloud.count
    if count is not None:
        count = number_of_originals(cloud.path.parent, count)

    def chunks(size: int) -> Iterator[CloudChunk]:
        left = sys.maxsize if count is None else count
        for chunk in cloud.chunks(size):
            yield chunk.select(slice(0, left))
            left -= len(chunk)
            if left <= 0:
                return

    known = path.stat()
    told = {"path": str(path), "bytes": known.st_size, "changed": known.st_mtime_ns}
    return Source(chunks, count, told, Scene(PointCloud.empty()), cloud.path)


def scene_source(scene: Scene) -> Source:
    """The originals of a scene, which a hash identifies; refuses attributes: tiles have none."""
    points, trusted = scene.points.originals, trusted_originals(scene)
    if points.attributes:
        raise OutputError(
            "originals with positions and colours only, to be written a piece at a time",
            found=f"{', '.join(points.attributes)} of them, in seeds.npz",
            fix="Leave out --memory and --executor, or remove seeds.npz.",
        )

    def chunks(size: int) -> Iterator[CloudChunk]:
        for first in range(0, len(points), size):
            part = slice(first, first + size)
            yield CloudChunk(points.xyz[part].astype(np.float64), points.rgb[part])

    digest = hashlib.blake2b(digest_size=16)
    for array in (points.xyz, points.rgb, np.ones(1, bool) if trusted is None else trusted):
        digest.update(np.ascontiguousarray(array).data)
    parts = [scene.points, scene.tracks, *(image.observations for image in scene.images)]
    values = [each for part in parts if part is not None for each in vars(part).values()]
    held = sum(each.nbytes for each in values if isinstance(each, np.ndarray))
    told = {"points": len(points), "digest": digest.hexdigest()}
    return Source(chunks, len(points), told, scene, trusted=trusted, held=held)


def read_rows(work: Path, source: Source, at_once: int, progress: Progress) -> None:
    """Copy a cloud to disk, ``at_once`` rows at a time."""
    low, high, exact = np.full(3, np.inf), np.full(3, -np.inf), True
    sample, share, count, rng = np.empty((0, 3)), 1.0, 0, np.random.default_rng(0)
    with staged(work / "rows", folder=False) as partial, partial.open("wb") as file:
        for chunk in source.chunks(at_once):
            rows = np.empty(len(chunk), ROW)
            rows["xyz"], rows["rgb"] = chunk.xyz, GREY if chunk.rgb is None else chunk.rgb
            rows.tofile(file)
            count += len(rows)
            finite = rows["xyz"][(np.abs(rows["xyz"]) < FARTHEST).all(axis=1)]
            low = np.minimum(low, finite.min(axis=0, initial=np.inf))
            high = np.maximum(high, finite.max(axis=0, initial=-np.inf))
            exact = exact and bool((finite == finite.astype(np.float32)).all())
            sample = np.concatenate([sample, finite[rng.random(len(finite)) < share]])
            while len(sample) > 2 * SAMPLE:
                sample, share = sample[rng.random(len(sample)) < 0.5], share / 2
            progress("read", count / source.count if source.count else 0.0)
    origin = origin_of(low, high, exact=exact)
    np.save(work / "sample.npy", _without_origin(sample, origin))
    finish(work, "read", {"rows": count, "origin": origin.tolist()})


def origin_of(
    low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], *, exact: bool
) -> Float64[np.ndarray, " 3"]:
    """The middle of a cloud's bounds in whole units if it lies far off, as on a national grid.

    Zero where float32 holds all coordinates as they are (``exact``), or where it is near zero.
    """
    far = max(float(np.abs(low).max()), float(np.abs(high).max()))
    if exact or not np.isfinite(far) or far <= FAR_OFF * float((high - low).max()):
        return np.zeros(3)
    return np.asarray(np.round((low + high) / 2))


def _without_origin(xyz: np.ndarray, origin: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        return np.asarray((xyz - origin).astype(np.float32))


class Rows:
    """The copied rows, read a piece at a time."""

    def __init__(self, work: Path) -> None:
        facts = facts_of(work, "read")
        self.work, self.count = work, int(facts["rows"])
        self.origin: Float64[np.ndarray, " 3"] = np.array(facts["origin"], np.float64)

    def cloud(self, first: int, last: int) -> PointCloud:
        """Rows, relative to the origin."""
        rows = np.fromfile(self.work / "rows", ROW, last - first, offset=ROW.itemsize * first)
        return PointCloud(_without_origin(rows["xyz"], self.origin), rows["rgb"].copy())

    def tiles(self, first: int, last: int) -> Int32[np.ndarray, " n"]:
        """The tiles of rows, -1 where one drops out."""
        return np.fromfile(self.work / "tile_of_row", np.int32, last - first, offset=4 * first)


class Cuts:
    """A kd-tree of a sample of finite positions; its leaves are tiles of at most ``most``."""

    def __init__(self, sample: Float32[np.ndarray, "s 3"], most: int) -> None:
        self.walls: list[Float64[np.ndarray, "2 3"]] = []
        self._root = cKDTree(sample, max(most, 1)).tree
        self._number: dict[Any, int] = {}
        self._visit(self._root, np.array([[-np.inf] * 3, [np.inf] * 3]))

    def _visit(self, node: Any, walls: np.ndarray) -> None:
        if node.split_dim < 0:
            self._number[node.start_idx] = len(self.walls)
            self.walls.append(walls)
            return
        below, above = walls.copy(), walls.copy()
        below[1, node.split_dim] = above[0, node.split_dim] = node.split
        self._visit(node.lesser, below)
        self._visit(node.greater, above)

    def tiles_of(self, xyz: Float32[np.ndarray, "n 3"]) -> Int32[np.ndarray, " n"]:
        """The tile of each point, int32 [n]."""
        wide = xyz.astype(np.float64)  # cuts can lie just behind a point, where float32 has none
        out, left = np.empty(len(xyz), np.int32), [(self._root, np.arange(len(xyz)))]
        while left:
            node, which = left.pop()
            if node.split_dim < 0:
                out[which] = self._number[node.start_idx]
            else:
                below = wide[which, node.split_dim] < node.split
                left += [(node.lesser, which[below]), (node.greater, which[~below])]
        return out


def tile_name(tile: int | np.integer[Any]) -> str:
    """The name of a tile's files."""
    return f"{tile:06d}"


def by_tile(tiles: Int32[np.ndarray, " n"]) -> Iterator[tuple[int, Int64[np.ndarray, " m"]]]:
    """The tiles that occur in an array, each with its places there in order."""
    order = np.argsort(tiles, kind="stable")
    names, first = np.unique(tiles[order], return_index=True)
    yield from zip(names.tolist(), np.split(order, first[1:]), strict=False)  # one piece of none


def append_by_tile(folder: Path, tiles: Int32[np.ndarray, " n"], records: np.ndarray) -> None:
    """Write records to the ends of their tiles' files."""
    for tile, places in by_tile(tiles):
        with (folder / tile_name(tile)).open("ab") as file:
            records[places].tofile(file)


def split(work: Path, source: Source, most: int, at_once: int, progress: Progress) -> None:
    """Sort the rows into tiles of at most ``most``; what is not finite or repeats drops out.

    Refused is a cloud without a finite row, or with too many points that no cut divides.
    """
    rows, sample = Rows(work), np.load(work / "sample.npy")
    sample = sample[np.isfinite(sample).all(axis=1)]
    share = len(sample) / max(rows.count, 1)
    wanted = share * most * (MARGIN if share < 1 else 1.0)
    for _ in range(TRIES):
        cuts = Cuts(sample, int(wanted))
        counts, non_finite = _distribute(rows, cuts, source.trusted, at_once, progress)
        if non_finite == rows.count:
            raise nothing_finite(rows.count)
        if counts.max() <= max(most, -(-rows.count // at_once)):  # one of each piece
            break
        wanted *= SMALLER
    else:
        raise ParameterError(
            f"at most {most:,} points in each of the tiles, which the memory is enough for",
            found=f"{counts.max():,} points that are too close together to be cut apart",
            fix="Allow more with --memory.",
        )
    bounds = _drop_repeats(work, counts, progress)
    n, total = int(counts.sum()), np.zeros(3)
    for first, last in blocks(rows.count, at_once, "centre", progress):
        xyz = rows.cloud(first, last).xyz[rows.tiles(first, last) >= 0].astype(np.float64)
        # NumPy adds rows one after another, so the sum is that of all rows at once.
        total = np.concatenate([total[None], xyz]).sum(axis=0)
    finish(work, "split", {
        "points": n, "most": max(most, int(counts.max())), "non_finite": non_finite,
        "repeats": rows.count - non_finite - n, "center": (total / n).tolist(),
        "walls": np.stack(cuts.walls).tolist(), "bounds": bounds.tolist(),
        "counts": counts.tolist(),
    })  # fmt: skip


def _distribute(
    rows: Rows,
    cuts: Cuts,
    trusted: Bool[np.ndarray, " rows"] | None,
    at_once: int,
    progress: Progress,
) -> tuple[Int64[np.ndarray, " t"], int]:
    """Write each row to its tile's file; returns the points of each and how many are not finite."""
    counts, non_finite = np.zeros(len(cuts.walls), np.int64), 0
    with (
        staged(rows.work / "tiles", folder=True) as folder,
        staged(rows.work / "tile_of_row", folder=False) as partial,
        partial.open("wb") as file,
    ):
        for first, last in blocks(rows.count, at_once, "tiles", progress):
            cloud = rows.cloud(first, last)
            kept = np.flatnonzero(cloud.distinct)
            tiles = np.full(len(cloud), -1, np.int32)
            tiles[kept] = cuts.tiles_of(cloud.xyz[kept])
            tiles.tofile(file)
            records = np.empty(len(kept), RECORD)
            records["xyz"], records["rgb"] = cloud.xyz[kept], cloud.rgb[kept]
            records["row"] = first + kept
            records["trusted"] = True if trusted is None else trusted[first + kept]
            append_by_tile(folder, tiles[kept], records)
            non_finite += int(np.count_nonzero(~cloud.finite))
            counts += np.bincount(tiles[kept], minlength=len(counts))
    return counts, non_finite


def _drop_repeats(
    work: Path, counts: Int64[np.ndarray, " t"], progress: Progress
) -> Float32[np.ndarray, "t 2 3"]:
    """Drop what repeats a position of an earlier piece, from ``counts``, too; returns bounds."""
    bounds = np.full((len(counts), 2, 3), np.nan, np.float32)
    for tile, _ in blocks(len(counts), 1, "tiles", progress):
        if not counts[tile]:
            continue
        path = work / "tiles" / tile_name(tile)
        records = np.fromfile(path, RECORD)
        kept = PointCloud(records["xyz"], records["rgb"]).distinct
        if not kept.all():
            tile_of_row = np.memmap(work / "tile_of_row", np.int32, "r+")
            tile_of_row[records["row"][~kept]] = -1
            tile_of_row.flush()
            records = records[kept]
            records.tofile(path)
        counts[tile] = len(records)
        bounds[tile] = records["xyz"].min(axis=0), records["xyz"].max(axis=0)
    return bounds


class TileStore:
    """The tiles of a cloud, read one at a time.

    ``walls`` and ``bounds`` are relative to the centroid; a tile without points has bounds of NaN.
    """

    def __init__(self, work: Path) -> None:
        facts = facts_of(work, "split")
        self.work = work
        self.count = int(facts["points"])
        self.center: Float64[np.ndarray, " 3"] = np.array(facts["center"], np.float64)
        self.counts: Int64[np.ndarray, " t"] = np.array(facts["counts"], np.int64)
        self.walls: Float64[np.ndarray, "t 2 3"] = np.array(facts["walls"]) - self.center
        self.bounds: Float64[np.ndarray, "t 2 3"] = np.array(facts["bounds"]) - self.center
        self.least = least_distance(float(np.nanmax(np.abs(self.bounds))))

    def points(self, tile: int, within: Float64[np.ndarray, "2 3"] | None = None) -> np.ndarray:
        """The points of a tile that has some, or those in a box, ``POINT`` [n]."""
        points = np.fromfile(self.work / "tiles" / tile_name(tile), RECORD).astype(POINT)
        points["xyz"] -= self.center
        if within is None:
            return points
        inside = (points["xyz"] >= within[0]) & (points["xyz"] <= within[1])
        return np.asarray(points[inside.all(axis=1)])
