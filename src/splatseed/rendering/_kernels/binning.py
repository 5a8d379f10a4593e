"""List the Gaussians that touch each tile, in depth order.

Notation: tiles are 8 x 8 px, numbered row by row; a *pair* is a Gaussian with a tile that its
ellipse touches, a *span* a Gaussian with the tiles that it touches in one row of tiles. Spans are
numbered by depth rank, then by row; pairs are listed by tile, then by depth rank;
``listed_span`` and ``listed_rank`` map list entries to spans and Gaussians. A Gaussian touches a
tile if its alpha reaches 1/255 within the rectangle of the tile's pixel centres. This is exact and
opacity-aware; a square of three sigmas would be far larger and still miss some pixels.
Promise: ties in depth are ordered by index; nothing depends on the number of threads.

Stages: spans are sorted by row as they are generated, then within each row by column. Both are
counting sorts, which preserve the depth order; the tiles of a row fit the L1 cache, those of an
entire image do not. Inner loops use unsigned indices: Numba checks every signed index for negative
values, which took a third of the time.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range

TILE = 8
"""Pixels along a tile's side: four blocks of 4 x 4, one vector each, fit the registers."""
RECORD = 16
"""Numbers in the record of a Gaussian; ``blending`` has its layout."""
MIN_EXPONENT = np.float32(-np.log(255.0) / 8)
"""log(alpha) / 8 at alpha = 1/255, the cut-off; records hold exponents of this scale."""
CHUNKS = 16
"""Parts of the depth order that are processed in parallel; independent of the thread count."""
STRIDE = 7
"""Stride from part to part: near Gaussians are large, and threads take consecutive turns."""
BITS, PASSES = 8, 4
"""Radix sort of 32-bit depths: bits per pass, and passes (even, so ``keys`` has the result)."""
SLACK = 0.01
"""Margin in px for rounding of an ellipse's edge."""


@inline
def sort_by_depth(depths, visible, keys, spare):
    """Radix-sort the visible Gaussians by depth, lowest digit first; stable.

    One thread does it: with two, eight synchronisations cost the gain.

    Args:
        depths: Bits of the depths, uint32 [N]; they sort like the floats, which are not negative.
        visible: bool [N].
        keys: Written: sorted depth bits << 32 | index, uint64 [N].
        spare: Workspace, uint64 [N].

    Returns:
        The number of visible Gaussians.
    """
    total, one, mask = np.uint64(0), np.uint32(1), np.uint64((1 << BITS) - 1)
    for i in range(len(depths)):
        # Branch-free: the next key overwrites that of an invisible Gaussian.
        keys[total] = np.uint64(depths[i]) << np.uint64(32) | np.uint64(i)
        total += np.uint64(visible[i])
    for turn in range(PASSES):
        shift, cursor = np.uint64(32 + BITS * turn), np.zeros(1 << BITS, np.uint32)
        for i in range(total):
            # Histogram of this digit, ...
            cursor[keys[i] >> shift & mask] += one
        # ... its running sum, the offset of each digit's keys, ...
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
def _ellipse(records, r):
    """Return A, B, C, R of A dx^2 + 2 B dx dy + C dy^2 <= R, with (dx, dy) = pixel - mean."""
    a, b, c = np.float64(records[r + 2]), np.float64(records[r + 3]), np.float64(records[r + 4])
    # alpha = 1/255 at the exponent MIN_EXPONENT; a record holds -A, -2 B, -C.
    reach = max(np.float64(records[r + 5]) - np.float64(MIN_EXPONENT), 0.0)
    return -a, -0.5 * b, -c, reach


@always_inline
def _tiles(low, high, tiles):
    """Return the range of tiles with a pixel centre from ``low`` to ``high``, px, end exclusive.

    Bounds are clipped before conversion to integers: those of a huge Gaussian would overflow.
    """
    # Pixel centres of tile t: 8 t + 0.5 to 8 t + 7.5.
    last_pixel = TILE - 0.5
    # The first tile whose last centre is not left of low; the last whose first is not right.
    first = min(max((low - (SLACK + last_pixel)) / TILE, 0.0), np.float64(tiles))
    last = min(max((high + (SLACK + last_pixel)) / TILE, 0.0), np.float64(tiles))
    return math.ceil(first), int(last)


@kernel
def find_rows(records, rows, row_range, touched):
    """Find the range of rows of tiles that each ellipse touches.

    These are all rows if float32 rounding left no ellipse (of a needle or sheet of thousands of
    pixels).

    Args:
        records: As in ``list_tiles``.
        rows: Rows of tiles.
        row_range: Written, end exclusive, int32 [G, 2].
        touched: Added to: +1 at a Gaussian's first row, -1 after its last,
            int64 [CHUNKS, rows + 1].
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
def find_columns(records, columns, row_range, span_start, cursor, spans, pairs):
    """Write the span of every Gaussian in each of its rows to the row's part of ``spans``.

    Within the strip of a row's pixel centres, an ellipse extends farthest at its own extreme point
    if that is in the strip, else at the strip's edge.

    Args:
        records: As in ``list_tiles``.
        columns: Tiles in a row.
        row_range: int32 [G, 2].
        span_start: As in ``TileLists``.
        cursor: Offset of each chunk's next span in each row, advanced, int64 [CHUNKS, rows].
        spans: Written: depth rank, first column, end column, span index, uint32 [S, 4].
        pairs: Number of pairs by chunk and row, added to, int64 [CHUNKS, rows].
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
                # The dy in the strip at which each edge is farthest from the centre.
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
def _profile(a, b, c, reach):
    """Return ``lean``, ``extreme``, ``width`` and ``falloff`` of an ellipse.

    Its edges at height dy are dx = lean dy +- sqrt(width - falloff dy^2); its rightmost point is at
    dy = extreme, its leftmost at -extreme. Without an ellipse (det <= 0), ``width`` is infinite.
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
def fill_tiles(row_order, columns, row_spans, spans, row_start, tile_start, ranks, listed):
    """List each row's spans by tile.

    Args:
        row_order: Order in which rows of tiles are processed, int64 [rows].
        columns: Tiles in a row.
        row_spans: Offset of each row in ``spans``, int64 [rows + 1].
        spans: As in ``find_columns``.
        row_start: First list entry of each row, int64 [rows + 1].
        tile_start: Written except for the last element, as in ``TileLists``.
        ranks: ``listed_rank``, written.
        listed: ``listed_span``, written.
    """
    one = np.uint64(1)
    for turn in parallel_range(len(row_order)):
        row = row_order[turn]
        start, end = np.uint64(row_spans[row]), np.uint64(row_spans[row + 1])
        cursor = np.zeros(columns + 1, np.uint64)
        # Counts by column, as differences: a span adds +1 at its first column, -1 after its last.
        for s in range(start, end):
            cursor[spans[s, 1]] += one
            cursor[spans[s, 2]] -= one
        entries, place = np.uint64(0), np.uint64(row_start[row])
        # Offset of each tile's entries; ``cursor`` changes from differences to offsets.
        for column in range(columns):
            entries += cursor[column]
            tile_start[row * columns + column] = cursor[column] = place
            place += entries
        for s in range(start, end):
            rank, span = spans[s, 0], spans[s, 3]
            for column in range(spans[s, 1], spans[s, 2]):
                place = cursor[column]
                ranks[place], listed[place] = rank, span
                cursor[column] = place + one
