"""List the Gaussians of each tile in depth order; ``_kernels.binning`` has the notation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt32

from splatseed.rendering._kernels import binning as kernels
from splatseed.rendering._kernels.binning import CHUNKS, RECORD, TILE

GOLDEN = 0.6180339887498949
"""Fraction of the golden ratio: any number of its multiples, modulo 1, spreads out evenly."""


class TileLists(NamedTuple):
    """The pairs of one view: G visible Gaussians in depth order, P pairs, S spans, t tiles."""

    span_start: Int64[np.ndarray, " G+1"]
    """First span of each Gaussian, by depth rank."""
    tile_start: Int64[np.ndarray, " t+1"]
    """First list entry of each tile."""
    listed_rank: Int32[np.ndarray, " P"]
    """Depth rank of each list entry."""
    listed_span: Int32[np.ndarray, " P"]
    """Span of each list entry."""


def row_order(rows: int) -> Int64[np.ndarray, " rows"]:
    """Order the rows of tiles so that every contiguous part samples the entire image.

    Threads process parts of equal length, but the rows of an image differ in work from top to
    bottom.
    """
    return np.argsort(np.arange(rows) * GOLDEN % 1.0)


def depth_order(
    depths: Float32[np.ndarray, " N"], visible: Bool[np.ndarray, " N"]
) -> UInt32[np.ndarray, " G"]:
    """Return the indices of the visible Gaussians, nearest first, ties by index.

    Depths must be at least 0.
    """
    keys, spare = np.empty((2, len(depths)), np.uint64)
    total = kernels.sort_by_depth(depths.view(np.uint32), visible, keys, spare)
    # keys = depth bits << 32 | index, so equal depths are ordered by index; keep the lower halves.
    return np.asarray(keys[:total].astype(np.uint32))


def list_tiles(records: Float32[np.ndarray, " 16*G"], width: int, height: int) -> TileLists:
    """List the pairs of Gaussians in depth order, with ``records`` as in ``_kernels.blending``.

    ``width`` and ``height`` are those of the image, px.
    """
    columns, rows, num = -(-width // TILE), -(-height // TILE), len(records) // RECORD
    row_range = np.empty((num, 2), np.int32)
    touched = np.zeros((CHUNKS, rows + 1), np.int64)
    kernels.find_rows(records, rows, row_range, touched)
    # ``spans`` is ordered by row, and within a row by chunk.
    # ``touched`` holds +1 at a Gaussian's first row, -1 after its last: running sums are counts.
    per_row = touched[:, :-1].cumsum(axis=1).T
    row_end = per_row.cumsum().reshape(rows, CHUNKS)
    row_spans = np.concatenate([[0], row_end[:, -1]])
    spans = np.empty((row_spans[-1], 4), np.uint32)
    span_start = np.zeros(num + 1, np.int64)
    np.cumsum(row_range[:, 1] - row_range[:, 0], out=span_start[1:])
    # Every chunk owns a part of each row, so chunks write without synchronisation.
    cursor = np.ascontiguousarray((row_end - per_row).T)
    pairs = np.zeros((CHUNKS, rows), np.int64)
    kernels.find_columns(records, columns, row_range, span_start, cursor, spans, pairs)
    row_start = np.concatenate([[0], pairs.sum(axis=0).cumsum()])
    tile_start = np.empty(rows * columns + 1, np.int64)
    tile_start[-1] = row_start[-1]
    ranks, listed = np.empty((2, row_start[-1]), np.int32)
    kernels.fill_tiles(
        row_order(rows), columns, row_spans, spans, row_start, tile_start, ranks, listed
    )
    return TileLists(span_start, tile_start, ranks, listed)
