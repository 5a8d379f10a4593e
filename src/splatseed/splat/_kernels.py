"""Compute L1 and SSIM of two images with their gradient, in one pass over the rows each.

Notation: x the render, y the photograph, [H, W, 3] channels interleaved; G the 11 x 11 Gaussian
window of standard deviation 1.5 px, applied where it fits ("valid"); mu_x = G*x, e_xy = G*(xy),
e_2 = G*(x^2 + y^2). With A1 = 2 mu_x mu_y + C1, A2 = 2 (e_xy - mu_x mu_y) + C2,
B1 = mu_x^2 + mu_y^2 + C1, B2 = e_2 - mu_x^2 - mu_y^2 + C2,

    SSIM = A1 A2 / (B1 B2)                                  (Wang et al. 2004, eq. 13)

needs four windowed means, as the variances appear only as a sum. Its derivatives are

    dS/dmu_x = 2 (mu_y (A2 - A1) + S mu_x (B1 - B2)) / (B1 B2)
    dS/de_xy = 2 A1 / (B1 B2),   dS/de_2 = -S / B2

and the gradient of the sum of S is G'*dS/dmu_x + y G'*dS/de_xy + 2 x G'*dS/de_2.

Promise: sums have a fixed order, so the bytes do not depend on the number of threads.

A row of interleaved channels is contiguous with taps 3 apart; ``simd`` processes 16 values at a
time. The derivative maps are padded with zeros, so that blurring them needs no border cases.
"""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range
from splatseed.runtime.simd import (
    LANES,
    add,
    broadcast,
    divide,
    fma,
    load,
    multiply,
    select_greater,
    store,
    subtract,
)

WINDOW, SIGMA = 11, 1.5
"""Side of the Gaussian window and its standard deviation, in pixels."""
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)
"""(K1 L)^2 and (K2 L)^2 of the paper, with L = 1 the range of values."""
HALF = WINDOW // 2
MARGIN = WINDOW - 1  # rows and columns lost to the valid window
CHANNELS = 3
REACH = MARGIN * CHANNELS  # values from the first tap of a row to the last
STRIP = 16  # rows per task; independent of the thread count, and so are the sums
TALL = STRIP + MARGIN  # rows that a strip reads
BLOCK = 480
"""Values of a row per block (at its end up to twice as many): the working set fits the L2 cache."""
WIDE = 2 * BLOCK + 3 * LANES
"""Values from row to row of a block, with its margin and padding to vectors: an odd number of cache
lines, so that a column spreads over the cache's sets."""


@always_inline
def _all_lanes(weights):
    return (
        broadcast(weights[0]), broadcast(weights[1]), broadcast(weights[2]),
        broadcast(weights[3]), broadcast(weights[4]), broadcast(weights[5]),
    )  # fmt: skip


@always_inline
def _window_mean(source, i, step, w):
    """Compute sixteen weighted means of eleven values ``step`` apart, folded at the centre."""
    total = multiply(w[5], load(source, i + 5 * step))
    total = fma(w[4], add(load(source, i + 4 * step), load(source, i + 6 * step)), total)
    total = fma(w[3], add(load(source, i + 3 * step), load(source, i + 7 * step)), total)
    total = fma(w[2], add(load(source, i + 2 * step), load(source, i + 8 * step)), total)
    total = fma(w[1], add(load(source, i + step), load(source, i + 9 * step)), total)
    return fma(w[0], add(load(source, i), load(source, i + 10 * step)), total)


@inline
def _blur_columns(source, start, step, rows, columns, weights, out):
    """Compute the vertical means of ``rows`` rows of a block, column of vectors by column."""
    w = _all_lanes(weights)
    for i in range(0, columns, LANES):
        for row in range(rows):
            store(out, row * WIDE + i, _window_mean(source, start + row * step + i, step, w))


@inline
def _copy_block(x, y, start, width, rows, columns, planes):
    plane_x, plane_y, plane_xy, plane_2 = planes[0], planes[1], planes[2], planes[3]
    for row in range(rows):
        for at in range(0, columns, LANES):
            i = min(at, columns - LANES)  # the last vector overlaps its predecessor
            a, b = load(x, start + row * width + i), load(y, start + row * width + i)
            store(plane_x, row * WIDE + i, a)
            store(plane_y, row * WIDE + i, b)
            store(plane_xy, row * WIDE + i, multiply(a, b))
            store(plane_2, row * WIDE + i, fma(a, a, multiply(b, b)))


@inline
def _similarity(means, at, columns, weights, partials, to, scores):
    """Compute SSIM and its three derivatives along a row from its vertical means."""
    w = _all_lanes(weights)
    mean_x, mean_y, mean_xy, mean_2 = means[0], means[1], means[2], means[3]
    by_mean, by_xy, by_2 = partials[0], partials[1], partials[2]
    two, c1, c2 = broadcast(np.float32(2.0)), broadcast(C1), broadcast(C2)
    for i in range(0, columns, LANES):
        mx = _window_mean(mean_x, at + i, CHANNELS, w)
        my = _window_mean(mean_y, at + i, CHANNELS, w)
        exy = _window_mean(mean_xy, at + i, CHANNELS, w)
        e2 = _window_mean(mean_2, at + i, CHANNELS, w)
        product, squares = multiply(mx, my), fma(mx, mx, multiply(my, my))
        # A1 = 2 mu_x mu_y + C1, A2 = 2 (e_xy - mu_x mu_y) + C2
        a1 = fma(two, product, c1)
        a2 = fma(two, subtract(exy, product), c2)
        # B1 = mu_x^2 + mu_y^2 + C1, B2 = e_2 - mu_x^2 - mu_y^2 + C2
        b1, b2 = add(squares, c1), add(subtract(e2, squares), c2)
        inverse = divide(broadcast(np.float32(1.0)), multiply(b1, b2))
        twice = multiply(two, inverse)
        ssim = multiply(multiply(a1, a2), inverse)
        # dS/dmu_x, dS/de_xy and dS/de_2 as in the header
        by_x = multiply(multiply(ssim, mx), subtract(b1, b2))
        store(by_mean, to + i, multiply(twice, fma(my, subtract(a2, a1), by_x)))
        store(by_xy, to + i, multiply(twice, a1))
        by_e2 = multiply(ssim, multiply(inverse, b1))
        store(by_2, to + i, subtract(broadcast(np.float32(0.0)), by_e2))
        store(scores, i, ssim)


@inline
def _blocks(width):
    """Return the number of blocks in a row of ``width`` values; the last has the remainder."""
    return max(1, width // BLOCK)


@inline
def _block_end(block, width):
    return width if block == _blocks(width) - 1 else (block + 1) * BLOCK


@inline
def _add_to(totals, values, count):
    for i in range(count):
        totals[i] += values[i]


@inline
def _sum(values):
    total = 0.0
    for i in range(len(values)):
        total += values[i]
    return total


@kernel
def forward(x, y, width, weights, partials, ssim_sums):
    """Write the derivative maps within their padding, and the sum of SSIM of each strip."""
    rows, columns, stride = len(x) // width - MARGIN, width - REACH, width + REACH
    maps = partials.reshape(3, -1)
    for strip in parallel_range(len(ssim_sums)):
        planes, means = np.zeros((2, 4, TALL * WIDE), np.float32)
        scores, totals = np.empty(WIDE, np.float32), np.zeros(WIDE, np.float32)
        first, count = strip * STRIP, min(STRIP, rows - strip * STRIP)
        for block in range(_blocks(columns)):
            left, size = block * BLOCK, _block_end(block, columns) - block * BLOCK
            _copy_block(x, y, first * width + left, width, count + MARGIN, size + REACH, planes)
            for m in range(4):
                _blur_columns(planes[m], 0, WIDE, count, size + REACH, weights, means[m])
            for row in range(count):
                to = (first + row + MARGIN) * stride + REACH + left
                _similarity(means, row * WIDE, size, weights, maps, to, scores)
                _add_to(totals, scores, size)
        partials[:, first + MARGIN : first + MARGIN + count, REACH + columns :] = np.float32(0.0)
        ssim_sums[strip] = _sum(totals)


@inline
def _combine(x, y, at, columns, means, row, weights, scales, gradient, differences):
    """Compute the gradient and |x - y| along a row, from the derivatives' vertical means."""
    w = _all_lanes(weights)
    of_mean, of_exy, of_e2 = means[0], means[1], means[2]
    zero, two = broadcast(np.float32(0.0)), broadcast(np.float32(2.0))
    by_ssim, by_l1 = broadcast(scales[0]), broadcast(scales[1])
    for start in range(0, columns, LANES):
        i = min(start, columns - LANES)
        a, b = load(x, at + i), load(y, at + i)
        by_mean = _window_mean(of_mean, row + i, CHANNELS, w)
        by_exy = _window_mean(of_exy, row + i, CHANNELS, w)
        by_e2 = _window_mean(of_e2, row + i, CHANNELS, w)
        # G'*dS/dmu_x + y G'*dS/de_xy + 2 x G'*dS/de_2
        ssim_part = fma(b, by_exy, fma(multiply(two, a), by_e2, by_mean))
        away, negative = subtract(a, b), subtract(b, a)
        # d |x - y| / dx = sign(x - y)
        slope = select_greater(away, zero, by_l1, zero)
        slope = select_greater(zero, away, subtract(zero, by_l1), slope)
        store(gradient, at + i, fma(by_ssim, ssim_part, slope))
        store(differences, i, select_greater(away, negative, away, negative))


@kernel
def backward(x, y, width, weights, partials, scales, l1_sums, gradient):
    """Write the gradient, and the sum of |x - y| of each strip."""
    height, stride = len(x) // width, width + REACH
    maps = partials.reshape(3, -1)
    for strip in parallel_range(len(l1_sums)):
        means = np.zeros((3, TALL * WIDE), np.float32)
        differences, totals = np.empty(WIDE, np.float32), np.zeros(WIDE, np.float32)
        first, count = strip * STRIP, min(STRIP, height - strip * STRIP)
        for block in range(_blocks(width)):
            left, size = block * BLOCK, _block_end(block, width) - block * BLOCK
            for m in range(3):
                start = first * stride + left
                _blur_columns(maps[m], start, stride, count, size + REACH, weights, means[m])
            for row in range(count):
                at = (first + row) * width + left
                _combine(x, y, at, size, means, row * WIDE, weights, scales, gradient, differences)
                _add_to(totals, differences, size)
        l1_sums[strip] = _sum(totals)
