"""All points in the order of the output: the originals in file order, then the new points.

New points lie in the folders of their tiles, each tile's in order; a run of the output is put
together from all tiles that have some of it. The method ``random`` has no tiles: in memory, the
positions of all M new points are drawn first, three numbers each, then their colours; here one
generator draws positions, and another, 3 M numbers ahead, colours. Promise: the order of the cloud
in memory; at most ``at_once`` points in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.progress import Progress, blocks, silent
from splatseed.tiles.reading import Rows
from splatseed.tiles.steps import made_name
from splatseed.tiles.store import TileStore
from splatseed.tiles.work import WorkFolder
from splatseed.upsample.methods.bounding_box import in_box

Piece = tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]


def originals(work: WorkFolder, at_once: int, progress: Progress) -> Iterator[Piece]:
    """The points of the cloud without what dropped out, in file order."""
    rows = Rows(work)
    path = work.file("dropped")
    dropped = np.memmap(path, "<i8", "r") if path.stat().st_size else np.empty(0, np.int64)
    for first, last in blocks(rows.count, at_once, "write", progress):
        kept = np.ones(last - first, bool)
        inside = slice(*np.searchsorted(dropped, (first, last)))
        kept[dropped[inside] - first] = False
        yield rows.xyz(first, last)[kept], rows.rgb(first, last)[kept]


def new_points(work: WorkFolder, at_once: int, progress: Progress) -> Iterator[Piece]:
    """The new points in the order in which they were drawn."""
    store, total = TileStore(work), int((work.facts("drawn") or {})["total"])
    ends = np.zeros(len(store), np.int64)
    for first, last in blocks(total, at_once, "write", progress):
        xyz, rgb = np.empty((last - first, 3), np.float32), np.empty((last - first, 3), np.uint8)
        for tile in np.flatnonzero(store.counts):
            ends[tile] = _put(work, int(tile), int(ends[tile]), (first, last), xyz, rgb)
        yield xyz, rgb


def _put(
    work: WorkFolder,
    tile: int,
    done: int,
    run: tuple[int, int],
    xyz: Float32[np.ndarray, "n 3"],
    rgb: UInt8[np.ndarray, "n 3"],
) -> int:
    """Put a tile's points of a run of the output into place.

    Args:
        work: The folder.
        tile: The tile.
        done: How many of its points lie before the run.
        run: First and last of the run.
        xyz: Positions of the run, written in place.
        rgb: Colours of the run, likewise.

    Returns:
        How many of its points lie before the end of the run.
    """
    name = made_name(tile)
    start = work.load(name, "start", mapped=True)
    if not len(start):
        return done
    # The base before the first that starts in the run may reach into it.
    bases = slice(max(int(np.searchsorted(start, run[0])) - 1, 0), np.searchsorted(start, run[1]))
    begin = np.array(start[bases])
    count = np.array(work.load(name, "count", mapped=True)[bases], np.int64)
    number = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
    inside = number[(number >= run[0]) & (number < run[1])] - run[0]
    part = slice(done, done + len(inside))
    xyz[inside] = work.load(name, "xyz", mapped=True)[part]
    rgb[inside] = work.load(name, "rgb", mapped=True)[part]
    return done + len(inside)


def box_points(
    work: WorkFolder, num_new: int, seed: int, at_once: int, progress: Progress
) -> Iterator[Piece]:
    """New points in the bounding box, a piece at a time; all colours are held in memory.

    Args:
        work: The folder, in which the rows are split.
        num_new: New points in all.
        seed: The seed.
        at_once: Points at a time.
        progress: Told the stage.
    """
    store = TileStore(work)
    colors = np.concatenate([rgb for _, rgb in originals(work, at_once, silent)])
    low, high = np.nanmin(store.bounds[:, 0], axis=0), np.nanmax(store.bounds[:, 1], axis=0)
    places, picks = np.random.default_rng(seed), _ahead(seed, 3 * num_new)
    for first, last in blocks(num_new, at_once, "write", progress):
        draws = places.random((last - first, 3), dtype=np.float32)
        draws[...] = in_box(draws, low, high, store.center)
        number = picks.integers(0, store.count, last - first, dtype=np.int32)
        yield draws, colors[number]


def _ahead(seed: int, floats: int) -> np.random.Generator:
    """A generator after so many float32, of which every 64-bit number gives two."""
    rng = np.random.default_rng(seed)
    bits = rng.bit_generator
    assert isinstance(bits, np.random.PCG64)  # noqa: S101  (NumPy's default)
    bits.advance(floats // 2)
    if floats % 2:
        rng.random(dtype=np.float32)
    return rng
