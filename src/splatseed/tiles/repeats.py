"""New points that repeat a position: left out of the output, as ``write_scene`` leaves them out.

Rounding to float32 can put two points of dense clouds in one place. Equal points lie within the
walls of one tile, whichever tiles made them; those that a tile made beyond its walls are *strays*
and are sorted, on disk, into the tiles that they lie in. Promise: of equal points the first stays,
originals before new ones, as ``PointCloud.distinct`` has it; memory holds one tile at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int64

from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks
from splatseed.tiles.splitting import RECORD, tile_name
from splatseed.tiles.steps import made_name
from splatseed.tiles.store import TileStore
from splatseed.tiles.work import WorkFolder

STRAY = np.dtype([("xyz", "<f4", 3), ("number", "<i8")])
"""A new point beyond the walls of the tile that made it, and its number in the output."""
STRAYS, FLAGS, STEP = "strays", "repeated", "repeats"

Numbered = tuple[Float32[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]


def find_repeats(work: WorkFolder, store: TileStore, num_new: int, progress: Progress) -> None:
    """Note which new points repeat a position, one byte each in file order.

    Args:
        work: The folder, in which all tiles are made.
        store: Its tiles.
        num_new: New points in all.
        progress: Told the stage.

    Raises:
        OSError: The disk is full.
    """
    walls = work.load("layout", "walls")
    _sort_strays(work, store, walls, progress)
    with work.partial(FLAGS).open("wb") as file:
        file.truncate(num_new)
    count = 0
    for tile, _ in blocks(len(store), 1, "repeats", progress):
        numbers = _repeats_in(work, store, tile, walls[tile])
        if len(numbers):  # mapped anew each time, so that pages of earlier tiles are let go
            np.memmap(f"{work.file(FLAGS)}.partial", np.uint8, "r+")[numbers] = 1
        count += len(numbers)
    work.complete(FLAGS)
    work.discard(STRAYS)
    work.finish(STEP, {"count": count})


def repeats_known(work: WorkFolder) -> int | None:
    """How many new points repeat a position; None while that is not known."""
    facts = work.facts(STEP)
    return None if facts is None else int(facts["count"])


def repeated(work: WorkFolder, first: int, last: int) -> Bool[np.ndarray, " n"]:
    """Which of a run of new points repeat a position."""
    if repeats_known(work) is None:
        return np.zeros(last - first, bool)
    flags = np.fromfile(work.file(FLAGS), np.uint8, last - first, offset=first)
    return np.asarray(flags != 0)


def _repeats_in(
    work: WorkFolder, store: TileStore, tile: int, walls: Float32[np.ndarray, "2 3"]
) -> Int64[np.ndarray, " r"]:
    """The numbers of the new points within a tile's walls that repeat a position."""
    xyz, numbers = _made(work, store, tile)
    at_home = _within(xyz, walls)
    visits = np.fromfile(work.file(STRAYS) / tile_name(tile), STRAY)
    numbers = np.concatenate([numbers[at_home], visits["number"]])
    order = np.argsort(numbers)
    new = np.concatenate([xyz[at_home], visits["xyz"]])[order]
    old = np.fromfile(work.file("tiles") / tile_name(tile), RECORD)["xyz"]
    both = np.concatenate([old, new])
    first = PointCloud(both, np.zeros(both.shape, np.uint8)).distinct[len(old) :]
    return np.asarray(numbers[order][~first])


def _sort_strays(
    work: WorkFolder, store: TileStore, walls: Float32[np.ndarray, "t 2 3"], progress: Progress
) -> None:
    """Write the strays of all tiles to files of the tiles that they lie in."""
    folder = work.partial(STRAYS)
    folder.mkdir()
    for tile in range(len(store)):
        (folder / tile_name(tile)).touch()
    for tile, _ in blocks(len(store), 1, "strays", progress):
        xyz, numbers = _made(work, store, tile)
        out = ~_within(xyz, walls[tile])
        strays = np.empty(int(np.count_nonzero(out)), STRAY)
        strays["xyz"], strays["number"] = xyz[out], numbers[out]
        for path, part in _homes(folder, strays, walls):
            with path.open("ab") as file:
                file.write(part.data)
    work.complete(STRAYS)


def _homes(
    folder: Path, strays: np.ndarray, walls: Float32[np.ndarray, "t 2 3"]
) -> Iterator[tuple[Path, np.ndarray]]:
    """Strays by the file of the tile that they lie in."""
    if not len(strays):
        return
    low, high = strays["xyz"].min(axis=0), strays["xyz"].max(axis=0)
    meets = ((walls[:, 0] <= high) & (walls[:, 1] > low)).all(axis=1)
    for tile in np.flatnonzero(meets):
        inside = _within(strays["xyz"], walls[tile])
        if inside.any():
            yield folder / tile_name(int(tile)), strays[inside]


def _made(work: WorkFolder, store: TileStore, tile: int) -> Numbered:
    """The new points of a tile and their numbers."""
    if not store.counts[tile]:
        return np.empty((0, 3), np.float32), np.empty(0, np.int64)
    name = made_name(tile)
    start, count = work.load(name, "start"), work.load(name, "count").astype(np.int64)
    number = np.repeat(start - np.cumsum(count) + count, count) + np.arange(count.sum())
    return work.load(name, "xyz"), number


def _within(xyz: Float32[np.ndarray, "n 3"], walls: np.ndarray) -> Bool[np.ndarray, " n"]:
    inside = np.ones(len(xyz), bool)
    for axis in range(3):
        inside &= (xyz[:, axis] >= walls[0, axis]) & (xyz[:, axis] < walls[1, axis])
    return inside
