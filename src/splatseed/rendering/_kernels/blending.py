"""Blend Gaussians into pixels, front to back; ``blending_vjp`` is the gradient.

Specification (``reference.py`` is its readable form): over the Gaussians of a pixel, nearest first,
sigma = (a dx^2 + c dy^2) / 2 + b dx dy, alpha = min(0.999, opacity exp(-sigma)); those with alpha <
1/255 are skipped; blending ends before the Gaussian that would bring the transmittance T to 1e-4 or
less; colour += alpha T c, T <- T (1 - alpha). (The reference also skips sigma < 0; records hold
ellipses, whose sigma is negative only by rounding.)

Notation: h = (log opacity - sigma) / 8, so that alpha = exp(8 h); ``top`` = log(opacity) / 8 is
h at sigma = 0; MIN_EXPONENT is h at alpha = 1/255. The transmittance of a finished pixel is stored
with a minus sign. A tile's 64 pixels are four blocks of 4 x 4, one vector each; the *hits* of a
Gaussian in a tile are a bit mask of the blocks to which it contributes.

Stages: a tile's list is processed in chunks. First, h is computed without branches for all four
blocks and every entry of the chunk, and the hits are recorded; then each block blends its hits with
all state in registers. A branch per block and Gaussian would double the time by misprediction.

Arrays: the *record* of a Gaussian is 16 float32 (table below). A block image is [tiles, 4 blocks,
channels, 16 lanes]. Arrays aligned to 64 bytes are fastest.
"""

from __future__ import annotations

import numpy as np

from splatseed.rendering._kernels.binning import MIN_EXPONENT, RECORD, TILE
from splatseed.runtime.jit import always_inline, kernel, parallel_range
from splatseed.runtime.simd import (
    LANES,
    add,
    aligned,
    any_greater,
    broadcast,
    broadcast_element,
    element,
    exp_of_eighth,
    fma,
    fnma,
    load,
    minimum,
    multiply,
    negative_magnitude,
    prefetch,
    select_greater,
    store,
    subtract,
)

CHANNELS = 4
"""Channels per pass; the fourth costs time only if used."""
BLOCKS = 4
"""Blocks of a tile."""
MIN_TRANSMITTANCE = np.float32(1e-4)
"""Transmittance at which a pixel is finished, as in 3DGS."""
MAX_ALPHA = np.float32(0.999)
"""Largest alpha, as in gsplat: the gradient divides by 1 - alpha."""
# The record of a Gaussian, RECORD float32:
#    0 1    2      3     4      5              6   7 .. 10        11 .. 15
#    x y    -a/16  -b/8  -c/16  log(opacity)/8 0   the channels   0
#
# Lane l of a block is the pixel in column l % 4 and row l // 4:
#    0  1  2  3      Blocks of a tile: 0 1
#    4  5  6  7                        2 3
#    8  9 10 11
#   12 13 14 15
COLUMN = np.tile(np.arange(4, dtype=np.float32), 4)
ROW = np.repeat(np.arange(4, dtype=np.float32), 4)
ZERO, ONE, HALF, FOUR = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(4.0)
STATE = (1 + CHANNELS) * LANES
"""Transmittance and channels of a block."""
CHUNK = 32
"""List entries per chunk: 8 KiB of h stay in the L1 cache."""
PREFETCH = 32
"""Distance of prefetching, list entries: the records of a tile are scattered over memory."""
ALL_BLOCKS = 15
"""The bits of all four blocks."""


@kernel
def forward(
    records, tile_start, listed_rank, row_order, lane_x, lane_y, fourth, image, transmittance, hits
):
    """Blend all tiles.

    Args:
        records: float32 [16 G], by depth rank.
        tile_start: [t + 1].
        listed_rank: int32 [P].
        row_order: Order in which rows of tiles are processed, int64 [rows].
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        fourth: Whether the last channel is used.
        image: Written: block image, float32 [t * 4 * CHANNELS * 16].
        transmittance: Written: T in front of the background, float32 [t * 4 * 16].
        hits: Written, uint8 [P]; a block finished before a chunk has none in that chunk.
    """
    columns = (len(tile_start) - 1) // len(row_order)
    for place in parallel_range(len(tile_start) - 1):
        row, column = row_order[place // columns], place % columns
        tile = row * columns + column
        # Pixel centres of the tile's upper left block; the other blocks are 4 px right and below.
        px = add(load(lane_x, 0), broadcast(np.float32(TILE * column + HALF)))
        py = add(load(lane_y, 0), broadcast(np.float32(TILE * row + HALF)))
        _forward_tile(
            records, listed_rank, tile_start[tile], tile_start[tile + 1], tile, px, py,
            fourth, image, transmittance, hits,
        )  # fmt: skip


@always_inline
def _forward_tile(
    records, listed_rank, first, last, tile, px, py, fourth, image, transmittance, hits
):  # fmt: skip
    chunk, lowest = CHUNK, broadcast(MIN_EXPONENT)
    right, below = add(px, broadcast(FOUR)), add(py, broadcast(FOUR))
    h, state = aligned(BLOCKS * chunk * LANES), aligned(BLOCKS * STATE)
    hit = np.empty(BLOCKS * chunk, np.int64)
    # A block is open while some pixel is unfinished; the tile ends when no block is open.
    open_blocks, start = np.int64(ALL_BLOCKS), first
    _clear(state)
    while start < last and open_blocks:
        n0 = n1 = n2 = n3 = 0
        stop = min(start + chunk, last)
        for entry in range(start, stop):
            ahead = min(entry + PREFETCH, len(listed_rank) - 1)  # may belong to the next tile
            prefetch(records, RECORD * np.int64(element(listed_rank, ahead)))
            r = RECORD * np.int64(element(listed_rank, entry))
            h0, h1, h2, h3 = _exponents(records, r, px, right, py, below)
            # Branch-free: the next entry overwrites that of a block that is not hit.
            hit[n0] = hit[chunk + n1] = hit[2 * chunk + n2] = hit[3 * chunk + n3] = r
            store(h, LANES * n0, h0)
            store(h, LANES * (chunk + n1), h1)
            store(h, LANES * (2 * chunk + n2), h2)
            store(h, LANES * (3 * chunk + n3), h3)
            hit0, hit1 = np.int64(any_greater(h0, lowest)), np.int64(any_greater(h1, lowest))
            hit2, hit3 = np.int64(any_greater(h2, lowest)), np.int64(any_greater(h3, lowest))
            n0, n1, n2, n3 = n0 + hit0, n1 + hit1, n2 + hit2, n3 + hit3
            hits[entry] = open_blocks & (hit0 | hit1 << 1 | hit2 << 2 | hit3 << 3)
        open_blocks = (
            _blend_block(records, hit, h, 0, n0, fourth, state)
            | _blend_block(records, hit, h, 1, n1, fourth, state) << 1
            | _blend_block(records, hit, h, 2, n2, fourth, state) << 2
            | _blend_block(records, hit, h, 3, n3, fourth, state) << 3
        )
        start = stop
    # Backward skips entries behind the last chunk.
    hits[start:last] = 0
    _write(state, tile, image, transmittance)


@always_inline
def _clear(state):
    """Set T = 1 and colour 0 at every pixel."""
    for q in range(BLOCKS):
        store(state, STATE * q, broadcast(ONE))
        # State of a block: 16 lanes of T, then 16 of each channel.
        for channel in range(CHANNELS):
            store(state, STATE * q + LANES * (1 + channel), broadcast(ZERO))


@always_inline
def _write(state, tile, image, transmittance):
    """Write a tile's colours and T to the block images."""
    for q in range(BLOCKS):
        block = BLOCKS * tile + q
        signed = negative_magnitude(load(state, STATE * q))  # -T of every pixel
        store(transmittance, LANES * block, subtract(broadcast(ZERO), signed))
        for channel in range(CHANNELS):
            color = load(state, STATE * q + LANES * (1 + channel))
            store(image, LANES * (CHANNELS * block + channel), color)


@always_inline
def _exponents(records, r, left, right, above, below):
    """Compute h of a Gaussian at the pixels of a tile's four blocks."""
    mean_x, mean_y = broadcast_element(records, r), broadcast_element(records, r + 1)
    a, b, c = (
        broadcast_element(records, r + 2),
        broadcast_element(records, r + 3),
        broadcast_element(records, r + 4),
    )
    # h = top - (a dx^2 + c dy^2) / 16 - b dx dy / 8; records hold -a/16, -b/8 and -c/16
    dx0, dx1 = subtract(mean_x, left), subtract(mean_x, right)
    dy0, dy1 = subtract(mean_y, above), subtract(mean_y, below)
    top = broadcast_element(records, r + 5)
    # Two columns and two rows of blocks share dx and dy: four h cost about as much as two.
    y0, y1 = fma(multiply(c, dy0), dy0, top), fma(multiply(c, dy1), dy1, top)
    x0, x1, cross0, cross1 = multiply(a, dx0), multiply(a, dx1), multiply(b, dy0), multiply(b, dy1)
    return (
        fma(add(x0, cross0), dx0, y0),
        fma(add(x1, cross0), dx1, y0),
        fma(add(x0, cross1), dx0, y1),
        fma(add(x1, cross1), dx1, y1),
    )


@always_inline
def _blend_block(records, hit, h, q, count, fourth, state):
    """Blend the hits of block q; return 1 if some pixel is unfinished, else 0."""
    zero, stop = broadcast(ZERO), broadcast(MIN_TRANSMITTANCE)
    base, first = STATE * q, CHUNK * q
    transmittance = load(state, base)
    c0, c1 = load(state, base + LANES), load(state, base + 2 * LANES)
    c2, c3 = load(state, base + 3 * LANES), load(state, base + 4 * LANES)
    for entry in range(first, first + count):
        r, exponent = element(hit, entry), load(h, LANES * entry)
        # alpha = min(0.999, exp(8 h)), and 0 below 1/255
        alpha = select_greater(exponent, broadcast(MIN_EXPONENT), exp_of_eighth(exponent), zero)
        alpha = minimum(alpha, broadcast(MAX_ALPHA))
        # T' = T (1 - alpha); where T' <= 1e-4 the pixel is finished: weight 0, T <- -T
        after = fnma(transmittance, alpha, transmittance)
        weight = select_greater(after, stop, multiply(transmittance, alpha), zero)
        transmittance = select_greater(after, stop, after, negative_magnitude(transmittance))
        # colour += alpha T c
        c0 = fma(weight, broadcast_element(records, r + 7), c0)
        c1 = fma(weight, broadcast_element(records, r + 8), c1)
        c2 = fma(weight, broadcast_element(records, r + 9), c2)
        if fourth:
            c3 = fma(weight, broadcast_element(records, r + 10), c3)
    store(state, base, transmittance)
    store(state, base + LANES, c0)
    store(state, base + 2 * LANES, c1)
    store(state, base + 3 * LANES, c2)
    store(state, base + 4 * LANES, c3)
    # Finished pixels are negative.
    return np.int64(any_greater(transmittance, zero))
