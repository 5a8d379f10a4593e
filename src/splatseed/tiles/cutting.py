"""The cloud on disk: copied as it is, then sorted into tiles.

Notation: a *row* is a point as the input has it, also one that is not finite or repeats another; a
*tile* is a box of a kd-tree whose cuts a sample of the rows decides, with *walls* (which may be
infinite) and the *bounds* of its points. ``rows`` holds all rows, ``tile_of_row`` int32 the tile of
each, -1 where it drops out, and ``tiles/NNNNNN`` the points of a tile in file order. Promise: what
is kept, its order and its centroid are those of the cloud in memory; coordinates keep the precision
of the input; every point is in exactly one tile.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from splatseed.errors import OutputError, ParameterError, PointCloudError
from splatseed.io.clouds import CloudChunk, CloudFile
from splatseed.io.seeds import number_of_originals
from splatseed.io.staging import staged
from splatseed.pointcloud import FARTHEST, PointCloud
from splatseed.progress import Progress, blocks
from splatseed.scene import Scene
from splatseed.tiles.work import facts_of, finish
from splatseed.upsample.neighbors import least_distance, trusted_originals

ROW = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
RECORD = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("trusted", "u1"), ("row", "<i8")])
"""A point of a tile."""
GREY = 128
"""The colour of points without one."""
SAMPLE = 1 << 20
"""Rows, at most twice as many, that the cuts are made by."""
FAR_OFF = 8.0
"""Coordinates farther from zero than this many extents of the cloud lose precision in float32."""
MARGIN, SMALLER, TRIES = 0.85, 0.7, 8
"""A sample tells the points of a tile only nearly: the share of the most that is aimed at, the
factor to it after each try that fails, and the tries."""


class Source(ABC):
    """Points that may be too many for memory, in the order of the cloud in memory.

    Attributes:
        count: How many there are; None if only reading tells.
        trusted: Which of them may be bases; None if all may.
        held: Bytes that it keeps in memory.
    """

    count: int | None
    held: int = 0
    trusted: Bool[np.ndarray, " n"] | None = None

    @abstractmethod
    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """The points in order, at most ``size`` at a time."""

    @abstractmethod
    def fingerprint(self) -> dict[str, object]:
        """What tells one input from another, as JSON has it."""


@dataclass
class FileSource(Source):
    """A file of points; those that splatseed added to it before are left out.

    Args:
        cloud: The file.
    """

    cloud: CloudFile

    def __post_init__(self) -> None:
        self.count = self.cloud.count
        if self.count is not None:
            self.count = number_of_originals(self.cloud.path.parent, self.count)

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """See ``Source``."""
        left = self.count if self.count is not None else np.iinfo(np.int64).max
        for chunk in self.cloud.chunks(size):
            if left <= 0:
                return
            yield chunk if len(chunk) <= left else chunk.select(slice(0, left))
            left -= len(chunk)

    def fingerprint(self) -> dict[str, object]:
        """See ``Source``: the file's name, size and time of change."""
        path = self.cloud.path.resolve()
        known = path.stat()
        return {"path": str(path), "bytes": known.st_size, "changed": known.st_mtime_ns}


@dataclass
class SceneSource(Source):
    """The originals of a scene.

    Args:
        scene: The scene; its originals come first.
    """

    scene: Scene

    def __post_init__(self) -> None:
        self.points = self.scene.points.originals
        if self.points.attributes:
            raise OutputError(
                "originals with positions and colours only, to be written a piece at a time",
                found=f"{', '.join(self.points.attributes)} of them, in seeds.npz",
                fix="Leave out --memory and --executor, or remove seeds.npz.",
            )
        self.count = len(self.points)
        self.trusted = trusted_originals(self.scene)
        seen = (image.observations for image in self.scene.images)
        parts = [self.scene.points, self.scene.tracks, *seen]
        values = [each for part in parts if part is not None for each in vars(part).values()]
        self.held = sum(each.nbytes for each in values if isinstance(each, np.ndarray))

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """See ``Source``."""
        for first in range(0, len(self.points), size):
            part = slice(first, first + size)
            yield CloudChunk(self.points.xyz[part].astype(np.float64), self.points.rgb[part])

    def fingerprint(self) -> dict[str, object]:
        """See ``Source``: a hash of the points."""
        digest = hashlib.blake2b(digest_size=16)
        trusted = np.ones(1, bool) if self.trusted is None else self.trusted
        for array in (self.points.xyz, self.points.rgb, trusted):
            digest.update(np.ascontiguousarray(array).data)
        return {"points": len(self.points), "digest": digest.hexdigest()}


def read_rows(work: Path, source: Source, at_once: int, progress: Progress) -> None:
    """Copy a cloud to disk.

    Args:
        work: The folder.
        source: The cloud.
        at_once: Rows in memory at a time.
        progress: Told the stage.

    Raises:
        OutputError: The disk is full.
    """
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
    np.save(work / "sample.npy", without_origin(sample, origin))
    finish(work, "read", {"rows": count, "origin": origin.tolist()})


def origin_of(
    low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], *, exact: bool
) -> Float64[np.ndarray, " 3"]:
    """The middle of the bounds in whole units where a cloud lies far off, as on a national grid.

    Zero where float32 holds the coordinates as they are, or where the cloud is near zero.

    Args:
        low: Least coordinates.
        high: Greatest coordinates.
        exact: Whether float32 holds them all.
    """
    far = max(float(np.abs(low).max()), float(np.abs(high).max()))
    if exact or not np.isfinite(far) or far <= FAR_OFF * float((high - low).max()):
        return np.zeros(3)
    return np.asarray(np.round((low + high) / 2))


def without_origin(
    xyz: Float64[np.ndarray, "n 3"], origin: Float64[np.ndarray, " 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Positions relative to the origin, as clouds hold them."""
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        return np.asarray((xyz - origin).astype(np.float32))


class Rows:
    """The copied rows, read a piece at a time.

    Args:
        work: The folder, in which the rows are read.
    """

    def __init__(self, work: Path) -> None:
        facts = facts_of(work, "read") or {}
        self._work = work
        self.count = int(facts["rows"])
        self.origin: Float64[np.ndarray, " 3"] = np.array(facts["origin"], np.float64)

    def cloud(self, first: int, last: int) -> PointCloud:
        """Rows, relative to the origin."""
        path = self._work / "rows"
        rows = np.fromfile(path, ROW, last - first, offset=ROW.itemsize * first)
        return PointCloud(without_origin(rows["xyz"], self.origin), rows["rgb"].copy())

    def tiles(self, first: int, last: int) -> Int32[np.ndarray, " n"]:
        """The tiles of rows, -1 where one drops out."""
        return np.fromfile(self._work / "tile_of_row", np.int32, last - first, offset=4 * first)


class Cuts:
    """A kd-tree that cuts a sample into parts of about the same size.

    Args:
        sample: Finite positions.
        parts: How many tiles are wanted; there are fewer where points coincide.
    """

    def __init__(self, sample: Float32[np.ndarray, "s 3"], parts: int) -> None:
        self.walls: list[Float32[np.ndarray, "2 3"]] = []
        everywhere = np.array([[-np.inf] * 3, [np.inf] * 3], np.float32)
        self._root = self._cut(sample, parts, everywhere)

    def __len__(self) -> int:
        """The number of tiles."""
        return len(self.walls)

    def _cut(self, sample: np.ndarray, parts: int, walls: np.ndarray) -> _Node:
        cut = _place_of_cut(sample, parts // 2 / parts) if parts > 1 and len(sample) else None
        if cut is None:
            self.walls.append(walls)
            return len(self.walls) - 1
        axis, at = cut
        below = sample[:, axis] < at
        left = min(max(round(np.count_nonzero(below) / len(sample) * parts), 1), parts - 1)
        inner = walls.copy(), walls.copy()
        inner[0][1, axis] = inner[1][0, axis] = at
        return (
            axis, at, self._cut(sample[below], left, inner[0]),
            self._cut(sample[~below], parts - left, inner[1]),
        )  # fmt: skip

    def tiles_of(self, xyz: Float32[np.ndarray, "n 3"]) -> Int32[np.ndarray, " n"]:
        """The tile of each point, int32 [n]."""
        out = np.empty(len(xyz), np.int32)
        left = [(self._root, np.arange(len(xyz)))]
        while left:
            node, which = left.pop()
            if isinstance(node, int):
                out[which] = node
            else:
                below = xyz[which, node[0]] < node[1]
                left += [(node[2], which[below]), (node[3], which[~below])]
        return out


_Node = tuple[int, np.float32, "_Node", "_Node"] | int
"""The axis and place of a cut and what is below and above it; or a tile's number."""


def _place_of_cut(sample: np.ndarray, share: float) -> tuple[int, np.float32] | None:
    """The axis and the place of a cut with about ``share`` of the sample below it, if any."""
    axis = int(np.argmax(sample.max(axis=0).astype(np.float64) - sample.min(axis=0)))
    values = sample[:, axis]
    at = np.partition(values, int(share * len(values)))[int(share * len(values))]
    if at > values.min():
        return axis, at
    above = values[values > at]  # else nothing would be below it
    return (axis, above.min()) if len(above) else None


def tile_name(tile: int | np.integer[Any]) -> str:
    """The name of a tile's files."""
    return f"{tile:06d}"


def by_tile(tiles: Int32[np.ndarray, " n"]) -> Iterator[tuple[int, Int64[np.ndarray, " m"]]]:
    """The tiles that occur in an array, each with its places there in order."""
    order = np.argsort(tiles, kind="stable")
    counts = np.bincount(tiles)
    ends = np.cumsum(counts)
    for tile in np.flatnonzero(counts):
        yield int(tile), order[ends[tile] - counts[tile] : ends[tile]]


def split(
    work: Path,
    trusted: Bool[np.ndarray, " rows"] | None,
    most: int,
    at_once: int,
    progress: Progress,
) -> None:
    """Sort the rows into tiles; what is not finite or repeats drops out.

    Args:
        work: The folder, in which the rows are read.
        trusted: Which rows may be bases; all when left out.
        most: Most points in a tile.
        at_once: Rows in memory at a time.
        progress: Told the stage.

    Raises:
        PointCloudError: No row is finite.
        ParameterError: More points than fit into memory lie so close that no cut divides them.
        OutputError: The disk is full.
    """
    rows, sample = Rows(work), np.load(work / "sample.npy")
    sample = sample[np.isfinite(sample).all(axis=1)]
    wanted = MARGIN * most if len(sample) < rows.count else float(most)
    for _ in range(TRIES):
        cuts = Cuts(sample, int(np.ceil(rows.count / max(wanted, 1))))
        counts, non_finite = _distribute(work, rows, cuts, trusted, at_once, progress)
        if non_finite == rows.count:
            raise PointCloudError(
                "at least one original point with finite coordinates",
                found=f"{rows.count} points, none of them finite and original",
                fix="Check that the scene holds the point cloud you meant.",
            )
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
    work: Path,
    rows: Rows,
    cuts: Cuts,
    trusted: Bool[np.ndarray, " rows"] | None,
    at_once: int,
    progress: Progress,
) -> tuple[Int64[np.ndarray, " t"], int]:
    """Write each row to its tile's file; returns the points of each and how many are not finite."""
    counts, non_finite = np.zeros(len(cuts), np.int64), 0
    with (
        staged(work / "tiles", folder=True) as folder,
        staged(work / "tile_of_row", folder=False) as partial,
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
            for tile, places in by_tile(tiles[kept]):
                with (folder / tile_name(tile)).open("ab") as each:
                    records[places].tofile(each)
            non_finite += int(np.count_nonzero(~cloud.finite))
            counts += np.bincount(tiles[kept], minlength=len(cuts))
    return counts, non_finite


def _drop_repeats(
    work: Path, counts: Int64[np.ndarray, " t"], progress: Progress
) -> Float32[np.ndarray, "t 2 3"]:
    """Drop what repeats a position of an earlier piece; returns the bounds of tiles.

    Args:
        work: The folder.
        counts: Points of each tile, changed in place.
        progress: Told the stage.
    """
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


@dataclass(frozen=True, eq=False)
class Points:
    """Some points, in file order unless said otherwise.

    Args:
        xyz: Positions relative to the centroid, float64 [n, 3].
        rgb: Colours, uint8 [n, 3].
        row: Rows, int64 [n].
        trusted: Which may be bases, bool [n].
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    row: Int64[np.ndarray, " n"]
    trusted: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, which: np.ndarray) -> Points:
        """The points at ``which``, in that order."""
        return Points(*(values[which] for values in vars(self).values()))

    @staticmethod
    def joined(*parts: Points) -> Points:
        """All points of the parts, one part after another."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return Points(*(np.concatenate(values) for values in columns))


class TileStore:
    """The tiles of a cloud, read one at a time.

    Args:
        work: The folder, in which the rows are split.

    Attributes:
        count: Points in all.
        center: Their centroid, float64 [3].
        counts: Points of each tile, int64 [t].
        walls: The boxes that space is divided into, relative to the centroid, float64 [t, 2, 3].
        bounds: Those of each tile's points, likewise; NaN where it has none.
        least: The least distance of two points.
    """

    def __init__(self, work: Path) -> None:
        facts = facts_of(work, "split") or {}
        self.work = work
        self.count = int(facts["points"])
        self.center: Float64[np.ndarray, " 3"] = np.array(facts["center"], np.float64)
        self.counts: Int64[np.ndarray, " t"] = np.array(facts["counts"], np.int64)
        self.walls: Float64[np.ndarray, "t 2 3"] = np.array(facts["walls"]) - self.center
        self.bounds: Float64[np.ndarray, "t 2 3"] = np.array(facts["bounds"]) - self.center
        self.least = least_distance(float(np.nanmax(np.abs(self.bounds))))

    def __len__(self) -> int:
        """The number of tiles."""
        return len(self.counts)

    def points(self, tile: int, within: Float64[np.ndarray, "2 3"] | None = None) -> Points:
        """The points of a tile that has some.

        Args:
            tile: Its number.
            within: Only those in this box, relative to the centroid; all when left out.
        """
        records = np.fromfile(self.work / "tiles" / tile_name(tile), RECORD)
        xyz = records["xyz"].astype(np.float64) - self.center
        if within is not None:
            inside = ((xyz >= within[0]) & (xyz <= within[1])).all(axis=1)
            records, xyz = records[inside], xyz[inside]
        return Points(xyz, records["rgb"].copy(), records["row"].copy(), records["trusted"] != 0)
