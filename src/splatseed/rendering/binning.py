"""Which Gaussians touch which tile, in depth order.

Notation: tiles are 8 x 8 px, numbered row by row; a *pair* is a Gaussian with a tile that its
ellipse touches, a *span* a Gaussian with the tiles that it touches in one row of tiles. Spans are
numbered Gaussian by Gaussian in depth order, and each Gaussian's by row; pairs are listed tile by
tile in depth order; ``listed_span`` and ``listed_rank`` map list entries to spans and Gaussians. A
Gaussian touches a tile if its alpha reaches 1/255 within the rectangle of the tile's pixel centres:
exact and opacity-aware, whereas a square of three sigmas would be far larger and still cut some
off.
Promise: ties in depth go by index; nothing depends on the number of threads.

Stages: spans are sorted by row as they are generated, then each row sorts its own by column. Both
are counting sorts, which preserve the depth order; a row's tiles stay in the L1 cache, where those
of the whole image would not. Indices are unsigned where it counts: Numba checks every signed index
for being negative, which took a third of the time.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt32

from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range

TILE = 8
"""Pixels along a tile's side: four blocks of 4 x 4, one vector each, fit the registers."""
RECORD = 16
"""Numbers in the record of a Gaussian, laid out in ``blending``."""
LOWEST = np.float32(-np.log(255.0) / 8)
"""Exponent log(alpha) / 8 at alpha = 1/255, as in a record."""
CHUNKS = 16
"""Pieces of the depth order that are processed in parallel, whatever the number of threads."""
STRIDE = 7
"""Pieces are taken in this stride: near Gaussians are large, and threads take consecutive turns."""
GOLDEN = 0.6180339887498949
"""Golden ratio's fraction: multiples of it, modulo 1, spread out evenly however many are taken."""
BITS, PASSES = 8, 4
"""Radix sort of a depth's 32 bits: bits per pass, and passes, an even number."""
SLACK = 0.01
"""Margin in pixels, in case rounding moved an ellipse's edge past a pixel centre."""


class TileLists(NamedTuple):
    """The pairs of one view: G visible Gaussians in depth order, P pairs, S spans, t tiles."""

    span_start: Int64[np.ndarray, " G+1"]
    """First span of each Gaussian (by depth rank), [G + 1]."""
    tile_start: Int64[np.ndarray, " t+1"]
    """First list entry of each tile, [t + 1]."""
    listed_rank: Int32[np.ndarray, " P"]
    """Depth rank of each list entry, [P]."""
    listed_span: Int32[np.ndarray, " P"]
    """Span of each list entry, [P]."""


def row_order(rows: int) -> Int64[np.ndarray, " rows"]:
    """Rows of tiles in an order in which every stretch samples all parts of the image.

    Threads take stretches of equal length, and images are rarely as busy at the top as below.
    """
    return np.argsort(np.arange(rows) * GOLDEN % 1.0)


def depth_order(depths: Float32[np.ndarray, " N"], visible: np.ndarray) -> UInt32[np.ndarray, " G"]:
    """Indices of the visible Gaussians, nearest first, ties by index; no depth may be negative."""
    keys, spare = np.empty((2, len(depths)), np.uint64)
    total = _sort(depths.view(np.uint32), visible, keys, spare)
    # keys = depth bits << 32 | index, so equal depths are ordered by index.
    # The lower halves are the indices.
    return keys[:total].astype(np.uint32)


def list_tiles(records: Float32[np.ndarray, " 16*G"], width: int, height: int) -> TileLists:
    """List the pairs of Gaussians given in depth order.

    Args:
        records: The Gaussians as ``blending`` reads them, [16 G].
        width: Image width in pixels.
        height: Image height in pixels.
    """
    columns, rows, num = -(-width // TILE), -(-height // TILE), len(records) // RECORD
    row_range = np.empty((num, 2), np.int32)
    touched = np.zeros((CHUNKS, rows + 1), np.int64)
    _find_rows(records, rows, row_range, touched)
    # ``spans`` is ordered by row, and within a row by chunk.
    # ``touched`` holds +1 where a Gaussian's rows begin, -1 where they end: sums give counts.
    per_row = touched[:, :-1].cumsum(axis=1).T
    row_end = per_row.cumsum().reshape(rows, CHUNKS)
    row_spans = np.concatenate([[0], row_end[:, -1]])
    spans = np.empty((row_spans[-1], 4), np.uint32)
    span_start = np.zeros(num + 1, np.int64)
    np.cumsum(row_range[:, 1] - row_range[:, 0], out=span_start[1:])
    # Every chunk has its own stretch of each row, so that chunks write without waiting.
    cursor = np.ascontiguousarray((row_end - per_row).T)
    pairs = np.zeros((CHUNKS, rows), np.int64)
    _find_columns(records, columns, row_range, span_start, cursor, spans, pairs)
    row_start = np.concatenate([[0], pairs.sum(axis=0).cumsum()])
    tile_start = np.empty(rows * columns + 1, np.int64)
    tile_start[-1] = row_start[-1]
    ranks, listed = np.empty((2, row_start[-1]), np.int32)
    _fill(row_order(rows), columns, row_spans, spans, row_start, tile_start, ranks, listed)
    return TileLists(span_start, tile_start, ranks, listed)


@inline
def _sort(depths, visible, keys, spare):  # type: ignore[no-untyped-def]  # Numba's types
    """Radix sort of the visible by depth, from the lowest digit; stable.

    On one thread: two gain as much as they lose by waiting for each other eight times.

    Args:
        depths: Their bits, uint32 [N]: positive floats sort as these do.
        visible: bool [N].
        keys: Written: depths above indices, sorted, uint64 [N].
        spare: Workspace, uint64 [N].

    Returns:
        The number of visible Gaussians.
    """
    total, one, mask = np.uint64(0), np.uint32(1), np.uint64((1 << BITS) - 1)
    for i in range(len(depths)):
        # Written unconditionally, and overwritten by the next if this one is not visible.
        keys[total] = np.uint64(depths[i]) << np.uint64(32) | np.uint64(i)
        total += np.uint64(visible[i])
    for turn in range(PASSES):
        shift, cursor = np.uint64(32 + BITS * turn), np.zeros(1 << BITS, np.uint32)
        for i in range(total):
            # Histogram of this digit, ...
            cursor[keys[i] >> shift & mask] += one
        # ... its running sum, where each digit's keys begin, ...
        place = np.uint32(0)
        for digit in range(1 << BITS):
            place, cursor[digit] = place + cursor[digit], place
        for i in range(total):
            key = keys[i]
            # ... and the keys in order of the digit; equal digits keep their order.
            digit = key >> shift & mask
            spare[cursor[digit]] = key
            cursor[digit] += one
        keys, spare = spare, keys
    return total


@always_inline
def _ellipse(records, r):  # type: ignore[no-untyped-def]  # Numba's types
    """A, B, C and R of the ellipse A dx^2 + 2 B dx dy + C dy^2 <= R, d being pixel minus mean."""
    a, b, c = np.float64(records[r + 2]), np.float64(records[r + 3]), np.float64(records[r + 4])
    # alpha = 1/255 where (log opacity - sigma) / 8 = LOWEST; records hold eighths and signs.
    reach = max(np.float64(records[r + 5]) - np.float64(LOWEST), 0.0)
    return -a, -0.5 * b, -c, reach


@always_inline
def _tiles(low, high, tiles):  # type: ignore[no-untyped-def]  # Numba's types
    """First and one-past-last of the tiles with a pixel centre between two coordinates.

    Clipped before conversion to integers, which the pixels of a huge Gaussian would overflow.
    """
    # Pixel centres of tile t: 8 t + 0.5 to 8 t + 7.5.
    last_pixel = TILE - 0.5
    # The first tile whose last centre is not left of low; the last whose first is not right.
    first = min(max((low - (SLACK + last_pixel)) / TILE, 0.0), np.float64(tiles))
    last = min(max((high + (SLACK + last_pixel)) / TILE, 0.0), np.float64(tiles))
    return math.ceil(first), int(last)


@kernel
def _find_rows(records, rows, row_range, touched):  # type: ignore[no-untyped-def]  # Numba's types
    """First and one-past-last row of tiles that each ellipse touches.

    All rows if float32 rounding has made the conic something other than an ellipse (a needle or a
    sheet of thousands of pixels).

    Args:
        records: As in ``list_tiles``.
        rows: Rows of tiles.
        row_range: Written, int32 [G, 2].
        touched: Change from row to row in how many of a chunk touch it, int64 [CHUNKS, rows + 1].
    """
    for k in parallel_range(CHUNKS):
        chunk = STRIDE * k % CHUNKS
        for g in range(chunk * len(row_range) // CHUNKS, (chunk + 1) * len(row_range) // CHUNKS):
            a, b, c, reach = _ellipse(records, RECORD * g)
            det, mean = a * c - b * b, np.float64(records[RECORD * g + 1])
            # The ellipse's half-height: max dy with A dx^2 + 2 B dx dy + C dy^2 = R
            extent = math.sqrt(reach * a / det) if det > 0.0 else np.inf
            first, last = _tiles(mean - extent, mean + extent, rows)
            row_range[g, 0], row_range[g, 1] = first, last
            touched[chunk, first] += 1
            touched[chunk, last] -= 1


@kernel
def _find_columns(  # type: ignore[no-untyped-def]  # Numba's types
    records, columns, row_range, span_start, cursor, spans, pairs
):
    """Write the span of every Gaussian in each of its rows to the row's part of ``spans``.

    Within the strip of a row's pixel centres an ellipse extends furthest at its own extreme point
    if that lies in the strip, else at the strip's edge.

    Args:
        records: As in ``list_tiles``.
        columns: Tiles in a row.
        row_range: int32 [G, 2].
        span_start: As in ``TileLists``.
        cursor: Where each chunk writes each row's next span, int64 [CHUNKS, rows].
        spans: Written: rank, first column, one past the last, number, uint32 [S, 4].
        pairs: Pairs of each chunk in each row are added to it, int64 [CHUNKS, rows].
    """
    for k in parallel_range(CHUNKS):
        chunk = STRIDE * k % CHUNKS
        for g in range(chunk * len(row_range) // CHUNKS, (chunk + 1) * len(row_range) // CHUNKS):
            x, y = np.float64(records[RECORD * g]), np.float64(records[RECORD * g + 1])
            lean, extreme, width, falloff = _profile(*_ellipse(records, RECORD * g))
            span = span_start[g]
            for row in range(row_range[g, 0], row_range[g, 1]):
                # The strip of the row's pixel centres, relative to the mean.
                low = row * TILE + 0.5 - y
                high = low + (TILE - 1)
                # The dy in the strip at which each edge is farthest out.
                right, left = min(max(extreme, low), high), min(max(-extreme, low), high)
                x_right = x + lean * right + math.sqrt(max(width - falloff * right * right, 0.0))
                x_left = x + lean * left - math.sqrt(max(width - falloff * left * left, 0.0))
                first, last = _tiles(x_left, x_right, columns)
                place = cursor[chunk, row]
                cursor[chunk, row] = place + 1
                spans[place, 0], spans[place, 1] = g, first
                spans[place, 2], spans[place, 3] = last, span
                pairs[chunk, row] += last - first
                span += 1


@always_inline
def _profile(a, b, c, reach):  # type: ignore[no-untyped-def]  # Numba's types
    """An ellipse's left and right edges at height dy: dx = lean dy +- sqrt(width - falloff dy^2).

    Also ``extreme``, the dy of the right extreme point; the left one's is its negative. Anything
    but an ellipse extends without end.
    """
    det = a * c - b * b
    if not det > 0.0:
        return 0.0, 0.0, np.inf, 0.0
    inverse = 1.0 / a
    # Where d/d dy of the right edge is 0.
    extreme = -b * math.sqrt(reach / (c * det))
    # Solved for dx: -(b / a) dy +- sqrt(R / a - (det / a^2) dy^2).
    return -b * inverse, extreme, reach * inverse, det * inverse * inverse


@kernel
def _fill(  # type: ignore[no-untyped-def]  # Numba's types
    row_order, columns, row_spans, spans, row_start, tile_start, ranks, listed
):
    """List each row's spans by tile.

    Args:
        row_order: The rows of tiles in the order in which they are taken, int64 [rows].
        columns: Tiles in a row.
        row_spans: Where in ``spans`` each row begins, int64 [rows + 1].
        spans: As in ``_find_columns``.
        row_start: First list entry of each row, int64 [rows + 1].
        tile_start: Written except for its end, as in ``TileLists``.
        ranks: ``listed_rank``, written.
        listed: ``listed_span``, written.
    """
    one = np.uint64(1)
    for turn in parallel_range(len(row_order)):
        row = row_order[turn]
        begin, end = np.uint64(row_spans[row]), np.uint64(row_spans[row + 1])
        cursor = np.zeros(columns + 1, np.uint64)
        # Counts by column, as differences: a span adds 1 where it begins, -1 behind its end.
        for s in range(begin, end):
            cursor[spans[s, 1]] += one
            cursor[spans[s, 2]] -= one
        entries, place = np.uint64(0), np.uint64(row_start[row])
        # Where each tile's entries begin; ``cursor`` changes from differences to places.
        for column in range(columns):
            entries += cursor[column]
            tile_start[row * columns + column] = cursor[column] = place
            place += entries
        for s in range(begin, end):
            rank, span = spans[s, 0], spans[s, 3]
            for column in range(spans[s, 1], spans[s, 2]):
                place = cursor[column]
                ranks[place], listed[place] = rank, span
                cursor[column] = place + one
