"""The method ``random`` without the cloud in memory: numbers from two places of one stream.

In memory, the positions of all M new points are drawn first, three numbers each, then their
colours. Here one generator draws positions, and another, 3 M numbers ahead, colours. Promise: the
points of ``upsample.methods.bounding_box``.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from splatseed.progress import Progress, blocks, silent
from splatseed.tiles.assembly import Piece, originals
from splatseed.tiles.store import TileStore
from splatseed.tiles.work import WorkFolder
from splatseed.upsample.methods.bounding_box import in_box

__all__ = ["box_points"]


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
