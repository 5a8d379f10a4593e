"""Gradients of ``blending``, whose notation and arrays this file shares.

It walks front to back again: the colour behind a Gaussian is the final image minus what has been
blended so far, so only the blocks that each Gaussian hits need be stored.

Notation: p = d loss / d sigma of one Gaussian at one pixel. Sums are kept per *span*, a Gaussian in
a row of tiles, over the row's pixels; their table is below. With pixels at (x, y) from a block's
centre and the mean at (mx, my), dx = mx - x, so all of them follow from the moments of p about the
centre.

Stages: per tile and block the hits are queued, then blended with all state in registers. p and the
weights alpha T of sixteen hits at a time are transposed, so that a vector holds one pixel of
sixteen Gaussians: their sums over pixels are then plain additions, and pixels have the same few
coordinates. One thread takes a row of tiles from left to right, so that a span's sums are added up
in a fixed order without atomics, while they are still in the cache: the same bytes every time.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np

from splatseed.rendering.binning import LOWEST, RECORD, TILE
from splatseed.rendering.blending import BLOCKS, CHANNELS, MAX_ALPHA, STOP
from splatseed.runtime.jit import always_inline, kernel, parallel_range
from splatseed.runtime.simd import (
    LANES,
    add,
    aligned,
    broadcast,
    broadcast_element,
    divide,
    element,
    exp_of_eighth,
    fma,
    fnma,
    lane_sum,
    load,
    load_columns,
    minimum,
    multiply,
    negative_magnitude,
    prefetch,
    select_greater,
    store,
    store_transposed,
    subtract,
)

SUMS = 16
"""Numbers per span, each summed over its pixels:

   0   1     2     3       4        5       6 .. 9       10          11          12 .. 15
   p   p dx  p dy  p dx^2  p dx dy  p dy^2  d channels   |d mean x|  |d mean y|  0
"""
ABSOLUTE = 10
"""Offset of the absolute gradients among them."""
CHUNK = 512
"""Entries of a tile's list that are queued at a time."""
AHEAD = 128
"""How many list entries ahead records and sums are prefetched."""
WEIGHTS, MEANS = LANES * LANES, 2 * LANES * LANES
"""Offsets of the weights alpha T and the means in a batch of sixteen hits; p is at 0."""
BATCH = MEANS + 2 * LANES
ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
OUTER = np.float32(1.5)
"""A block's columns and rows are at -OUTER, -HALF, HALF and OUTER from its centre."""


@kernel
def backward(
    records, tile_start, listed_rank, listed_span, hits, row_order, lane_x, lane_y, fourth,
    gradient,
    behind, absolute, sums,
):  # fmt: skip
    """The sums of every span.

    Args:
        records: As in ``blending.forward``.
        tile_start: As there.
        listed_rank: As there.
        listed_span: The span of each list entry, int32 [P].
        hits: As ``blending.forward`` wrote them.
        row_order: As there.
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        fourth: Whether the last channel is used.
        gradient: d loss / d image, block image, float32 [t * 4 * CHANNELS * 16].
        behind: gradient . final colour - (d loss / d alpha) T_final, float32 [t * 4 * 16];
            overwritten.
        absolute: Whether the absolute gradients of the means are wanted; else they are 0.
        sums: Written: float32 [16 S]; must hold 0.
    """
    columns = (len(tile_start) - 1) // len(row_order)
    for place in parallel_range(len(row_order)):
        row = row_order[place]
        queue, batch = np.empty(BLOCKS * CHUNK, np.int32), aligned(BATCH)
        transmittance = aligned(BLOCKS * LANES)
        for column in range(columns):
            tile = row * columns + column
            for q in range(BLOCKS):
                store(transmittance, LANES * q, broadcast(ONE))
            for start in range(tile_start[tile], tile_start[tile + 1], CHUNK):
                stop = min(start + CHUNK, tile_start[tile + 1])
                counts = _queue_hits(
                    hits, start, stop, records, listed_rank, sums, listed_span, queue
                )
                for q in range(BLOCKS):
                    x = np.float32(TILE * column + 4 * (q % 2))
                    y = np.float32(TILE * row + 4 * (q // 2))
                    block = LANES * (BLOCKS * tile + q)
                    if fourth:  # specialised by the compiler
                        _backward_block(
                            records, listed_rank, listed_span, queue, CHUNK * q, counts[q],
                            lane_x, lane_y, x, y, True, gradient, CHANNELS * block, behind, block,
                            transmittance, LANES * q, absolute, batch, sums,
                        )  # fmt: skip
                    else:
                        _backward_block(
                            records, listed_rank, listed_span, queue, CHUNK * q, counts[q],
                            lane_x, lane_y, x, y, False, gradient, CHANNELS * block, behind, block,
                            transmittance, LANES * q, absolute, batch, sums,
                        )  # fmt: skip


@always_inline
def _queue_hits(hits, start, stop, records, listed_rank, sums, listed_span, queue):
    """Queue the list entries that hit each block, and prefetch their data; returns the counts.

    Waiting for memory is otherwise a third of the time.
    """
    n0 = n1 = n2 = n3 = 0
    for entry in range(start, stop):
        bits = np.int64(hits[entry])
        # Both are scattered over memory: asked for now, they are there when their turn comes.
        ahead = min(entry + AHEAD, len(hits) - 1)  # it may be the next tile's
        prefetch(records, RECORD * np.int64(listed_rank[ahead]))
        prefetch(sums, SUMS * np.int64(listed_span[ahead]))
        # Written unconditionally, and overwritten by the next if the block is not hit.
        queue[n0] = queue[CHUNK + n1] = queue[2 * CHUNK + n2] = queue[3 * CHUNK + n3] = entry
        n0 += bits & 1
        n1 += bits >> 1 & 1
        n2 += bits >> 2 & 1
        n3 += bits >> 3
    return n0, n1, n2, n3


@always_inline
def _backward_block(
    records, listed_rank, listed_span, queue, first, count, lane_x, lane_y, x, y, fourth, gradient,
    gradient_at, behind, behind_at, transmittance, at, absolute, batch, sums,
):  # fmt: skip
    """Blend the ``count`` hits from ``queue[first]`` of the block whose corner is (x, y).

    ``gradient_at``, ``behind_at`` and ``at`` are the block's offsets in the preceding arrays.
    """
    zero, stop = broadcast(ZERO), broadcast(STOP)
    px, py = add(load(lane_x, 0), broadcast(x + HALF)), add(load(lane_y, 0), broadcast(y + HALF))
    # Carried from chunk to chunk: T in front of the next Gaussian, and what lies behind it.
    t, far = load(transmittance, at), load(behind, behind_at)
    v0, v1 = load(gradient, gradient_at), load(gradient, gradient_at + LANES)
    v2, v3 = load(gradient, gradient_at + 2 * LANES), load(gradient, gradient_at + 3 * LANES)
    for begin in range(first, first + count, LANES):
        end = min(begin + LANES, first + count)
        # Alphas first: they are independent, and overlap with the dependent chain below.
        for k in range(end - begin):
            r = RECORD * _looked_up(listed_rank, queue, begin + k)
            batch[MEANS + k] = element(records, r)
            batch[MEANS + LANES + k] = element(records, r + 1)
            store(batch, LANES * k, _alpha(records, r, px, py))
        for k in range(end - begin):
            r = RECORD * _looked_up(listed_rank, queue, begin + k)
            alpha = load(batch, LANES * k)
            after = fnma(t, alpha, t)  # T' = T (1 - alpha)
            # Where forward stopped, backward stops: alpha 0 gives p = 0 and weight 0.
            alpha = select_greater(after, stop, alpha, zero)
            weight = multiply(t, alpha)
            # shade = gradient . c, and far = gradient . (colour behind this Gaussian)
            shade = multiply(v0, broadcast_element(records, r + 7))
            shade = fma(v1, broadcast_element(records, r + 8), shade)
            shade = fma(v2, broadcast_element(records, r + 9), shade)
            if fourth:
                shade = fma(v3, broadcast_element(records, r + 10), shade)
            far = fnma(weight, shade, far)
            # d loss / d alpha = T shade - far / (1 - alpha); with d alpha / d sigma = -alpha,
            # p = d loss / d sigma = (far / (1 - alpha) - T shade) alpha
            slope = fnma(t, shade, divide(far, subtract(broadcast(ONE), alpha)))
            # A clamped alpha is constant.
            p = select_greater(broadcast(MAX_ALPHA), alpha, multiply(slope, alpha), zero)
            # T = 0 keeps a finished pixel finished.
            t = select_greater(after, stop, after, zero)
            store(batch, LANES * k, p)
            store(batch, WEIGHTS + LANES * k, weight)
        if absolute:
            _add_absolute(records, listed_rank, listed_span, queue, begin, end, px, py, batch, sums)
        _reduce(batch, x + np.float32(2.0), y + np.float32(2.0), gradient, gradient_at, fourth)
        for k in range(end - begin):
            s = SUMS * _looked_up(listed_span, queue, begin + k)
            store(sums, s, add(load(sums, s), load(batch, LANES * k)))
    store(transmittance, at, t)
    store(behind, behind_at, far)


@always_inline
def _looked_up(array, queue, place):
    """The element of an int32 array at the list entry in a place of the queue, int64."""
    return np.int64(element(array, np.int64(element(queue, place))))


@always_inline
def _alpha(records, r, px, py):
    """min(0.999, exp(8 h)) where that is at least 1/255, else 0."""
    dx, dy = (
        subtract(broadcast_element(records, r), px),
        subtract(broadcast_element(records, r + 1), py),
    )
    a, b, c = (
        broadcast_element(records, r + 2),
        broadcast_element(records, r + 3),
        broadcast_element(records, r + 4),
    )
    h = fma(multiply(c, dy), dy, broadcast_element(records, r + 5))
    h = fma(add(multiply(a, dx), multiply(b, dy)), dx, h)
    alpha = select_greater(h, broadcast(LOWEST), exp_of_eighth(h), broadcast(ZERO))
    return minimum(alpha, broadcast(MAX_ALPHA))


@always_inline
def _reduce(batch, center_x, center_y, gradient, gradient_at, fourth):
    """From p, weights and means of sixteen hits to their sums over the block, one per row."""
    zero = broadcast(ZERO)
    # Moments of p over x within each row of the block, then over y: s = sum p, x = sum p x, ...
    s0, x0, xx0 = _moments(load_columns(batch, 0))
    s1, x1, xx1 = _moments(load_columns(batch, 4))
    s2, x2, xx2 = _moments(load_columns(batch, 8))
    s3, x3, xx3 = _moments(load_columns(batch, 12))
    s, y, yy = _moments((s0, s1, s2, s3))
    # The rows' sums give s, y, yy; their first moments give x and xy, as sums over y.
    x, xy, _ = _moments((x0, x1, x2, x3))
    xx = add(add(xx0, xx3), add(xx1, xx2))
    mx, my = load(batch, MEANS), load(batch, MEANS + LANES)
    mx, my = subtract(mx, broadcast(center_x)), subtract(my, broadcast(center_y))
    # With dx = mx - x: sum p dx = mx s - x, sum p dx^2 = mx (sum p dx - x) + xx, and
    # sum p dx dy = mx sum p dy - my x + xy
    px, py = subtract(multiply(mx, s), x), subtract(multiply(my, s), y)
    pxx, pyy = fma(mx, subtract(px, x), xx), fma(my, subtract(py, y), yy)
    pxy = fma(mx, py, fnma(my, x, xy))
    # d channel = sum over pixels of alpha T times the pixel's gradient
    c0 = c1 = c2 = c3 = zero
    for pixel in range(0, LANES, 4):
        weights, first = load_columns(batch, WEIGHTS + pixel), gradient_at + pixel
        c0 = _add_products(c0, weights, gradient, first)
        c1 = _add_products(c1, weights, gradient, first + LANES)
        c2 = _add_products(c2, weights, gradient, first + 2 * LANES)
        if fourth:
            c3 = _add_products(c3, weights, gradient, first + 3 * LANES)
    store_transposed(
        batch, 0,
        (s, px, py, pxx, pxy, pyy, c0, c1, c2, c3, zero, zero, zero, zero, zero, zero),
    )  # fmt: skip


@always_inline
def _moments(values):
    """Sum, first and second moment of four values at -OUTER, -HALF, HALF and OUTER."""
    a, b, c, d = values
    # At +-3/2 and +-1/2: even moments need only the sums of the pairs, odd ones the differences.
    outer, inner = add(a, d), add(b, c)
    first = fma(subtract(d, a), broadcast(OUTER), multiply(subtract(c, b), broadcast(HALF)))
    second = fma(outer, broadcast(OUTER * OUTER), multiply(inner, broadcast(HALF * HALF)))
    return add(outer, inner), first, second


@always_inline
def _add_products(total, weights, values, first):
    """``total`` plus weights[i] values[first + i] for four weights."""
    total = fma(weights[0], broadcast_element(values, first), total)
    total = fma(weights[1], broadcast_element(values, first + 1), total)
    total = fma(weights[2], broadcast_element(values, first + 2), total)
    return fma(weights[3], broadcast_element(values, first + 3), total)


@always_inline
def _add_absolute(records, listed_rank, listed_span, queue, begin, end, px, py, batch, sums):
    """Add each pixel's |a p dx + b p dy| and |b p dx + c p dy| to the absolute sums, per hit."""
    for k in range(end - begin):
        entry = queue[begin + k]
        r, s = RECORD * np.int64(listed_rank[entry]), SUMS * np.int64(listed_span[entry])
        p = load(batch, LANES * k)
        along_x = multiply(p, subtract(broadcast_element(records, r), px))
        along_y = multiply(p, subtract(broadcast_element(records, r + 1), py))
        # records hold -a/16, -b/8, -c/16
        a, b = (
            broadcast(np.float32(-16.0) * records[r + 2]),
            broadcast(np.float32(-8.0) * records[r + 3]),
        )
        c = broadcast(np.float32(-16.0) * records[r + 4])
        step_x = fma(a, along_x, multiply(b, along_y))
        step_y = fma(b, along_x, multiply(c, along_y))
        # d mean x = a p dx + b p dy; minus minus its magnitude, as only the sign bit need be set
        sums[s + ABSOLUTE] -= lane_sum(negative_magnitude(step_x))
        sums[s + ABSOLUTE + 1] -= lane_sum(negative_magnitude(step_y))


@kernel
def sum_spans(span_start, sums, totals):
    """Add up each Gaussian's spans in order: [16 S] to [G, 16] by depth rank."""
    for g in parallel_range(len(totals)):
        total = broadcast(ZERO)
        for span in range(span_start[g], span_start[g + 1]):
            total = add(total, load(sums, SUMS * span))
        store(totals[g], 0, total)
