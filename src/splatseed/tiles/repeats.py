"""New points that repeat a position: left out of the output, as ``write_scene`` leaves them out.

Rounding to float32 can put two points of dense clouds in one place. Equal points lie within the
walls of one tile, whichever tiles made them; those that a tile made beyond its walls are *strays*
and are compared in the tile that they lie in. Promise: of equal points the first stays, originals
before new ones, as ``PointCloud.distinct`` has it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int64

from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks
from splatseed.tiles.splitting import RECORD, tile_name
from splatseed.tiles.steps import made_name
from splatseed.tiles.store import TileStore
from splatseed.tiles.work import WorkFolder

__all__ = ["find_repeats"]

Numbered = tuple[Float32[np.ndarray, "n 3"], Int64[np.ndarray, " n"]]


def find_repeats(work: WorkFolder, store: TileStore, progress: Progress) -> None:
    """Save the numbers of the new points that repeat a position, ascending.

    Args:
        work: The folder, in which all tiles are made.
        store: Its tiles.
        progress: Told the stage.
    """
    walls = work.load("layout", "walls")
    strays = [_beyond(work, store, tile, walls[tile]) for tile in range(len(store))]
    xyz = np.concatenate([each for each, _ in strays])
    number = np.concatenate([each for _, each in strays])
    found = [np.empty(0, np.int64)]
    for tile, _ in blocks(len(store), 1, "repeats", progress):
        inner, numbers = _made(work, store, tile)
        at_home, visits = _within(inner, walls[tile]), _within(xyz, walls[tile])
        numbers = np.concatenate([numbers[at_home], number[visits]])
        order = np.argsort(numbers)
        new = np.concatenate([inner[at_home], xyz[visits]])[order]
        old = np.fromfile(work.file("tiles") / tile_name(tile), RECORD)["xyz"]
        both = np.concatenate([old, new])
        first = PointCloud(both, np.zeros(both.shape, np.uint8)).distinct[len(old) :]
        found.append(numbers[order][~first])
    work.save("repeats", {"number": np.sort(np.concatenate(found))})


def _made(work: WorkFolder, store: TileStore, tile: int) -> Numbered:
    """The new points of a tile and their numbers."""
    if not store.counts[tile]:
        return np.empty((0, 3), np.float32), np.empty(0, np.int64)
    name = made_name(tile)
    start, count = work.load(name, "start"), work.load(name, "count").astype(np.int64)
    number = np.repeat(start - np.cumsum(count) + count, count) + np.arange(count.sum())
    return work.load(name, "xyz"), number


def _beyond(work: WorkFolder, store: TileStore, tile: int, walls: np.ndarray) -> Numbered:
    xyz, number = _made(work, store, tile)
    out = ~_within(xyz, walls)
    return xyz[out], number[out]


def _within(xyz: Float32[np.ndarray, "n 3"], walls: np.ndarray) -> Bool[np.ndarray, " n"]:
    inside = np.ones(len(xyz), bool)
    for axis in range(3):
        inside &= (xyz[:, axis] >= walls[0, axis]) & (xyz[:, axis] < walls[1, axis])
    return inside
