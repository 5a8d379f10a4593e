"""Which Gaussians touch which tile, in depth order.

Notation: tiles are 8 x 8 px, numbered row by row; a *pair* is a Gaussian with a tile that its ellipse
touches. Pairs are numbered Gaussian by Gaussian in depth order (their *slot*), and listed tile by tile
in depth order; ``listed_slot`` and ``listed_rank`` lead from the list back to slot and Gaussian.
A Gaussian counts as touching a tile if within the rectangle of the tile's pixel centres its alpha
reaches 1/255: exact, and opacity-aware, where a square of three sigmas would be far larger and still
cut some off.
Promise: ties in depth go by index; nothing depends on the number of threads.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64

from splatseed.jit import always_inline, kernel, parallel_range

__all__ = ["TILE", "TileLists", "depth_order", "list_tiles"]

TILE = 8
CHUNKS = 16
"""Pieces of the depth order that are counted and listed in parallel, whatever the threads."""
STRIDE = 7
"""Pieces are taken in this stride: near Gaussians are large, and threads take consecutive turns."""


class TileLists(NamedTuple):
    """The pairs of one view: G visible Gaussians in depth order, P pairs, t tiles."""

    slot_start: Int64[np.ndarray, " G+1"]
    """First slot of each Gaussian (by depth rank), [G + 1]."""
    tile_start: Int64[np.ndarray, " t+1"]
    """First list entry of each tile, [t + 1]."""
    listed_rank: Int32[np.ndarray, " P"]
    """Depth rank of each list entry, [P]."""
    listed_slot: Int32[np.ndarray, " P"]
    """Slot of each list entry, [P]."""


def depth_order(depths: Float32[np.ndarray, " N"], visible: np.ndarray) -> Int64[np.ndarray, " G"]:
    """Indices of the visible Gaussians, nearest first, ties by index."""
    idx = np.flatnonzero(visible)
    # Positive floats sort as their bits do; with the index below them the order is total.
    keys = depths[idx].view(np.uint32).astype(np.uint64) << np.uint64(32) | idx.astype(np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)


def list_tiles(
    means2d: Float32[np.ndarray, "G 2"],
    conics: Float32[np.ndarray, "G 3"],
    reach: Float32[np.ndarray, " G"],
    width: int,
    height: int,
) -> TileLists:
    """List the pairs of Gaussians given in depth order.

    Args:
        means2d: Centres in pixels, [G, 2].
        conics: Inverse covariances (a, b, c), [G, 3].
        reach: log(255 opacity), [G]: how large sigma can be for alpha to reach 1/255.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    first_row, row_start = np.empty(len(reach), np.int32), np.zeros(len(reach) + 1, np.int64)
    _count_rows(means2d, conics, reach, rows, first_row, row_start[1:])
    np.cumsum(row_start, out=row_start)
    spans = np.empty((row_start[-1], 2), np.int32)
    slot_start = np.zeros(len(reach) + 1, np.int64)
    counts = np.zeros((CHUNKS, rows * columns), np.int64)
    _count_tiles(
        means2d, conics, reach, columns, first_row, row_start, spans, slot_start[1:], counts
    )
    np.cumsum(slot_start, out=slot_start)
    tile_start = np.concatenate([[0], np.cumsum(counts.sum(axis=0))])
    cursor = tile_start[:-1] + np.cumsum(counts, axis=0) - counts
    listed = np.empty((2, slot_start[-1]), np.int32)
    _fill(columns, first_row, row_start, spans, slot_start, cursor, listed[0], listed[1])
    return TileLists(slot_start, tile_start, listed[0], listed[1])


@always_inline
def _row_range(a, b, c, reach, mx, my, row, columns):  # type: ignore[no-untyped-def]
    """First and one-past-last tile column that an ellipse touches in one row of tiles.

    The ellipse is {d : (a dx^2 + 2 b dx dy + c dy^2) / 2 <= reach}, d the pixel less the mean. Its
    extent along x within the strip of the row's pixel centres is at its own extreme point, where
    dy = -+b x_max / c, if that lies in the strip, else at the strip's edge.
    """
    low, high = row * TILE + 0.5 - my, row * TILE + (TILE - 0.5) - my
    det = a * c - b * b
    if not det > 0.0:
        return 0, columns
    y_max = math.sqrt(2.0 * reach * a / det)
    if low > y_max or high < -y_max:
        return 0, 0
    x_max = math.sqrt(2.0 * reach * c / det)
    at_right = min(max(-b * x_max / c, low), high)
    at_left = min(max(b * x_max / c, low), high)
    right = (-b * at_right + math.sqrt(max(2.0 * reach * a - det * at_right * at_right, 0.0))) / a
    left = (-b * at_left - math.sqrt(max(2.0 * reach * a - det * at_left * at_left, 0.0))) / a
    # A pixel's slack, in case rounding moved the edge past a pixel centre.
    return _clipped(mx + left - 0.5 - 0.01, mx + right - 0.5 + 0.01, columns)


@always_inline
def _rows(a, b, c, reach, my, rows):  # type: ignore[no-untyped-def]
    """First and one-past-last row of tiles that an ellipse touches.

    All of them where float32 has rounded the conic to one that is no ellipse (a needle or a sheet of
    thousands of pixels).
    """
    det = a * c - b * b
    if not det > 0.0:
        return 0, rows
    y_max = math.sqrt(2.0 * reach * a / det)
    return _clipped(my - y_max - 0.5 - 0.01, my + y_max - 0.5 + 0.01, rows)


@always_inline
def _clipped(low, high, tiles):  # type: ignore[no-untyped-def]
    """First and one-past-last of the tiles between two pixels.

    Clipped while still floats: the pixels of a giant overflow integers.
    """
    first = min(max(low / TILE, 0.0), np.float64(tiles))
    last = min(max(high / TILE + 1.0, 0.0), np.float64(tiles))
    return int(first), int(last)


@kernel
def _count_rows(means2d, conics, reach, rows, first_row, count):  # type: ignore[no-untyped-def]
    for g in parallel_range(len(reach)):
        a, b, c = np.float64(conics[g, 0]), np.float64(conics[g, 1]), np.float64(conics[g, 2])
        first, last = _rows(a, b, c, reach[g], means2d[g, 1], rows)
        first_row[g], count[g] = first, max(last - first, 0)


@kernel
def _count_tiles(  # type: ignore[no-untyped-def]
    means2d, conics, reach, columns, first_row, row_start, spans, pairs, counts
):
    """The span of columns of every row of tiles, and how many pairs that makes."""
    for k in parallel_range(CHUNKS):
        chunk, total = STRIDE * k % CHUNKS, len(reach)
        for g in range(chunk * total // CHUNKS, (chunk + 1) * total // CHUNKS):
            a, b, c = np.float64(conics[g, 0]), np.float64(conics[g, 1]), np.float64(conics[g, 2])
            pairs[g] = 0
            for entry in range(row_start[g], row_start[g + 1]):
                row = first_row[g] + entry - row_start[g]
                first, last = _row_range(
                    a, b, c, reach[g], means2d[g, 0], means2d[g, 1], row, columns
                )
                spans[entry, 0], spans[entry, 1] = first, last
                pairs[g] += max(last - first, 0)
                for column in range(first, last):
                    counts[chunk, row * columns + column] += 1


@kernel
def _fill(  # type: ignore[no-untyped-def]
    columns, first_row, row_start, spans, slot_start, cursor, listed_rank, listed_slot
):
    """A stable counting sort: chunks write to places that were set aside for them."""
    for k in parallel_range(CHUNKS):
        chunk, total = STRIDE * k % CHUNKS, len(first_row)
        for g in range(chunk * total // CHUNKS, (chunk + 1) * total // CHUNKS):
            slot = slot_start[g]
            for entry in range(row_start[g], row_start[g + 1]):
                row = first_row[g] + entry - row_start[g]
                for column in range(spans[entry, 0], spans[entry, 1]):
                    tile = row * columns + column
                    place = cursor[chunk, tile]
                    listed_rank[place], listed_slot[place] = g, slot
                    cursor[chunk, tile] = place + 1
                    slot += 1
