"""Compute the gradients of ``blending``, with its notation and arrays.

The order is front to back again: the colour behind a Gaussian is the final image minus the colour
blended so far, so the forward pass stores only hits.

Notation: p = d loss / d sigma of one Gaussian at one pixel. Sums (table below) are kept per *span*,
a Gaussian in a row of tiles, over the row's pixels. With pixels at (x, y) and the mean at (mx, my),
both relative to a block's centre, dx = mx - x, so all sums follow from the moments of p about the
centre.

Stages: per tile and block, hits are queued, then blended with all state in registers. p and the
weights alpha T of sixteen hits are transposed, so that a vector holds one pixel of sixteen
Gaussians: sums over pixels become additions of vectors, and pixels have the same few coordinates.
One thread processes a row of tiles from left to right: the sums of a span are added in a fixed
order without atomics, while they are in the cache.
"""

from __future__ import annotations

import numpy as np

from splatseed.rendering._kernels.binning import MIN_EXPONENT, RECORD, TILE
from splatseed.rendering._kernels.blending import BLOCKS, CHANNELS, MAX_ALPHA, MIN_TRANSMITTANCE
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
"""Numbers per span, summed over its pixels:

   0   1     2     3       4        5       6 .. 9       10          11          12 .. 15
   p   p dx  p dy  p dx^2  p dx dy  p dy^2  d channels   |d mean x|  |d mean y|  0
"""
ABSOLUTE = 10
"""Offset of the absolute gradients in the sums."""
CHUNK = 512
"""List entries that are queued at a time."""
PREFETCH = 128
"""Distance of prefetching of records and sums, list entries."""
WEIGHTS, MEANS = LANES * LANES, 2 * LANES * LANES
"""Offsets of the weights alpha T and of the means in a batch of sixteen hits; p is at 0."""
BATCH = MEANS + 2 * LANES
ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
OUTER = np.float32(1.5)
"""Columns and rows of a block are at -OUTER, -HALF, HALF and OUTER from its centre, px."""


@kernel
def backward(
    records, tile_start, listed_rank, listed_span, hits, row_order, lane_x, lane_y, fourth,
    gradient, behind, absolute, sums,
):  # fmt: skip
    """Compute the sums of every span.

    Args:
        records: As in ``blending.forward``.
        tile_start: As in ``blending.forward``.
        listed_rank: As in ``blending.forward``.
        listed_span: The span of each list entry, int32 [P].
        hits: Those of ``blending.forward``.
        row_order: As in ``blending.forward``.
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        fourth: Whether the last channel is used.
        gradient: d loss / d image, block image, float32 [t * 4 * CHANNELS * 16].
        behind: gradient . final colour - (d loss / d alpha) T_final, float32 [t * 4 * 16];
            overwritten.
        absolute: Whether to compute the absolute gradients of the means; else they are 0.
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
    """Queue the list entries that hit each block, prefetch their data, and return the counts.

    Without prefetching, memory latency takes a third of the time.
    """
    n0 = n1 = n2 = n3 = 0
    for entry in range(start, stop):
        bits = np.int64(hits[entry])
        ahead = min(entry + PREFETCH, len(hits) - 1)  # may belong to the next tile
        prefetch(records, RECORD * np.int64(listed_rank[ahead]))
        prefetch(sums, SUMS * np.int64(listed_span[ahead]))
        # Branch-free: the next entry overwrites that of a block that is not hit.
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
    """Blend ``count`` hits, from ``queue[first]`` on, of the block with its corner at (x, y), px.

    ``gradient_at``, ``behind_at`` and ``at`` are the block's offsets in the arrays before them.
    """
    zero, stop = broadcast(ZERO), broadcast(MIN_TRANSMITTANCE)
    px, py = add(load(lane_x, 0), broadcast(x + HALF)), add(load(lane_y, 0), broadcast(y + HALF))
    # Carried from chunk to chunk: T in front of the next Gaussian, and ``far`` (below).
    t, far = load(transmittance, at), load(behind, behind_at)
    v0, v1 = load(gradient, gradient_at), load(gradient, gradient_at + LANES)
    v2, v3 = load(gradient, gradient_at + 2 * LANES), load(gradient, gradient_at + 3 * LANES)
    for start in range(first, first + count, LANES):
        end = min(start + LANES, first + count)
        # Alphas first: they are independent of each other, unlike the chain below.
        for k in range(end - start):
            r = RECORD * _lookup(listed_rank, queue, start + k)
            batch[MEANS + k] = element(records, r)
            batch[MEANS + LANES + k] = element(records, r + 1)
            store(batch, LANES * k, _alpha(records, r, px, py))
        for k in range(end - start):
            r = RECORD * _lookup(listed_rank, queue, start + k)
            alpha = load(batch, LANES * k)
            after = fnma(t, alpha, t)  # T' = T (1 - alpha)
            # Where the pixel was finished, alpha = 0 gives p = 0 and weight 0.
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
            _add_absolute(records, listed_rank, listed_span, queue, start, end, px, py, batch, sums)
        _reduce(batch, x + np.float32(2.0), y + np.float32(2.0), gradient, gradient_at, fourth)
        for k in range(end - start):
            s = SUMS * _lookup(listed_span, queue, start + k)
            store(sums, s, add(load(sums, s), load(batch, LANES * k)))
    store(transmittance, at, t)
    store(behind, behind_at, far)


@always_inline
def _lookup(array, queue, place):
    """Return the element of an int32 array at a queued list entry, int64."""
    return np.int64(element(array, np.int64(element(queue, place))))


@always_inline
def _alpha(records, r, px, py):
    """Compute alpha = min(0.999, exp(8 h)), or 0 below 1/255."""
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
    alpha = select_greater(h, broadcast(MIN_EXPONENT), exp_of_eighth(h), broadcast(ZERO))
    return minimum(alpha, broadcast(MAX_ALPHA))


@always_inline
def _reduce(batch, center_x, center_y, gradient, gradient_at, fourth):
    """Reduce p, weights and means of sixteen hits to their sums over the block, a row per hit."""
    zero = broadcast(ZERO)
    # Moments of p over x within each row of the block, then over y: s = sum p, x = sum p x, ...
    s0, x0, xx0 = _moments(load_columns(batch, 0))
    s1, x1, xx1 = _moments(load_columns(batch, 4))
    s2, x2, xx2 = _moments(load_columns(batch, 8))
    s3, x3, xx3 = _moments(load_columns(batch, 12))
    s, y, yy = _moments((s0, s1, s2, s3))
    # The first moments of the rows give x and xy.
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
    """Return sum, first and second moment of four values at -OUTER, -HALF, HALF and OUTER."""
    a, b, c, d = values
    # At +-3/2 and +-1/2: even moments need only the sums of the pairs, odd ones the differences.
    outer, inner = add(a, d), add(b, c)
    first = fma(subtract(d, a), broadcast(OUTER), multiply(subtract(c, b), broadcast(HALF)))
    second = fma(outer, broadcast(OUTER * OUTER), multiply(inner, broadcast(HALF * HALF)))
    return add(outer, inner), first, second


@always_inline
def _add_products(total, weights, values, first):
    """Return total + sum_i weights[i] values[first + i] over four weights."""
    total = fma(weights[0], broadcast_element(values, first), total)
    total = fma(weights[1], broadcast_element(values, first + 1), total)
    total = fma(weights[2], broadcast_element(values, first + 2), total)
    return fma(weights[3], broadcast_element(values, first + 3), total)


@always_inline
def _add_absolute(records, listed_rank, listed_span, queue, start, end, px, py, batch, sums):
    """Add |a p dx + b p dy| and |b p dx + c p dy| of every pixel to the absolute sums."""
    for k in range(end - start):
        entry = queue[start + k]
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
        # |d mean x| = |a p dx + b p dy|, subtracted as -|.|: setting a sign bit is cheap
        sums[s + ABSOLUTE] -= lane_sum(negative_magnitude(step_x))
        sums[s + ABSOLUTE + 1] -= lane_sum(negative_magnitude(step_y))


@kernel
def sum_spans(span_start, sums, totals):
    """Sum the spans of each Gaussian in order: [16 S] to [G, 16] by depth rank."""
    for g in parallel_range(len(totals)):
        total = broadcast(ZERO)
        for span in range(span_start[g], span_start[g + 1]):
            total = add(total, load(sums, SUMS * span))
        store(totals[g], 0, total)
