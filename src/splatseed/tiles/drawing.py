"""The draw of the bases: how many new points each point makes, in file order as in memory.

Weights come from the tiles and counts go back to them. Because each tile keeps its points in file
order, the points of a run of ranks are the next ones of every tile, so that all files are read and
written from front to back. Promise: the same draws from the generator as ``draw_bases`` makes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.progress import Progress, blocks
from splatseed.tiles.splitting import by_tile, tile_name
from splatseed.tiles.steps import weighed_name
from splatseed.tiles.store import TileStore
from splatseed.tiles.stream import stream_state
from splatseed.tiles.work import WorkFolder
from splatseed.upsample import neighbors


def draw(work: WorkFolder, num_new: int, seed: int, progress: Progress) -> None:
    """Draw the bases of all new points.

    Written are ``drawn/NNNNNN.start`` int64 and ``.count`` int32, by position in the tile.

    Args:
        work: The folder, in which all tiles are weighed.
        num_new: New points in all.
        seed: The seed.
        progress: Told the stage.

    Raises:
        OSError: The disk is full.
    """
    store, rng = TileStore(work), np.random.default_rng(seed)
    sums = np.array([weight.sum() for _, weight in _weights(work, store, progress)])
    alike = not sums.any()  # no weight at all: every point is as likely as any other
    if alike:
        sums = np.array([float(len(tiles)) for tiles, _ in _weights(work, store, progress)])
    totals = neighbors.draw_blocks(sums, num_new, rng)
    folder, first = work.partial("drawn"), 0
    folder.mkdir()
    for tile in range(len(store)):
        for name in ("start", "count"):
            (folder / f"{tile_name(tile)}.{name}").touch()
    for total, (tiles, weight) in zip(totals, _weights(work, store, progress), strict=True):
        counts = neighbors.draw_in_block(np.ones_like(weight) if alike else weight, total, rng)
        _hand_out(folder, tiles, first + np.cumsum(counts) - counts, counts)
        first += int(total)
    work.complete("drawn")
    work.finish("drawn", {"total": num_new, "stream": stream_state(rng)})


def _weights(
    work: WorkFolder, store: TileStore, progress: Progress
) -> Iterator[tuple[Int64[np.ndarray, " b"], Float64[np.ndarray, " b"]]]:
    """The tiles and the weights of each block of ranks in turn."""
    taken = np.zeros(len(store), np.int64)
    for first, last in blocks(store.count, neighbors.DRAW_BLOCK, "draw", progress):
        path = work.file("tile_of_rank")
        tiles = np.fromfile(path, np.int32, last - first, offset=4 * first)
        weight = np.empty(last - first)
        for tile, places in by_tile(tiles):
            known = work.load(weighed_name(tile), "weight", mapped=True)
            weight[places] = known[taken[tile] : taken[tile] + len(places)]
            taken[tile] += len(places)
        yield tiles, weight


def _hand_out(folder: Path, tiles: np.ndarray, start: np.ndarray, count: np.ndarray) -> None:
    """Append what was drawn for a block of ranks to the files of their tiles."""
    for tile, places in by_tile(tiles):
        for name, values in (("start", start.astype("<i8")), ("count", count.astype("<i4"))):
            with (folder / f"{tile_name(tile)}.{name}").open("ab") as file:
                file.write(values[places].data)
