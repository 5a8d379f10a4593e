"""Front-to-back blending of Gaussians into pixels, forward and backward.

Specification (``reference.py`` is its readable form): over the Gaussians of a pixel, nearest first,
sigma = (a dx^2 + c dy^2) / 2 + b dx dy, alpha = min(0.999, opacity exp(-sigma)); those with sigma < 0
or alpha < 1/255 are skipped; blending ends before the Gaussian that would bring the transmittance T
to 1e-4 or less; colour += alpha T c, T <- T (1 - alpha).

Notation: h = (log opacity - sigma) / 8, so that alpha = exp(8 h); ``top`` = log(opacity) / 8 is where
sigma is 0; LOWEST is where alpha is 1/255. A pixel that is done keeps its transmittance with a minus
sign. A tile's 64 pixels are four blocks of 4 x 4, one vector each.

Stages: both directions take a tile's list in chunks. First h is formed for all four blocks and a
whole chunk, without a branch, and which blocks are met is noted down; then only those are blended.
Deciding block by block instead costs half of the time: the processor guesses such branches wrong, and
finds out late. Forward then takes block by block and keeps all state in registers. Backward takes
Gaussian by Gaussian, so that the sums over pixels are formed once per tile, and walks front to back
again: with the image known, what lies behind a Gaussian is what the image has less what has been
blended so far, so nothing need be stored. Each pair has a place of its own for its sums, added up per
Gaussian in a fixed order afterwards: no atomics, the same bytes every time.

Arrays: a *record* of a Gaussian is 16 float32: mean x, y; -a/16, -b/8, -c/16; top; 0; four channels;
rest 0. A block image is [tiles, 4 blocks, channels, 16 lanes]. Arrays that begin at a multiple of 64
bytes are read and written fastest.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np

from splatseed.jit import always_inline, inline, kernel, parallel_range
from splatseed.render.binning import TILE
from splatseed.render.simd import (
    LANES,
    add,
    any_greater,
    divide,
    exp_of_eighth,
    fma,
    lane_sums,
    load,
    minimum,
    multiply,
    negative_magnitude,
    select_greater,
    splat,
    store,
    subtract,
)

__all__ = ["BLOCKS", "CHANNELS", "RECORD", "SUMS", "backward", "forward", "sum_pairs"]

CHANNELS = 4
RECORD = 16
BLOCKS = 4
SUMS = 16
"""Numbers per pair, sums over pixels of p = d loss / d sigma: p; p dx, p dy; p dx^2, p dx dy, p dy^2;
d channels; |d mean x|, |d mean y|; rest 0."""
STOP = np.float32(1e-4)
MAX_ALPHA = np.float32(0.999)
LOWEST = np.float32(-np.log(255.0) / 8)
COLUMN = np.tile(np.arange(4, dtype=np.float32), 4)
ROW = np.repeat(np.arange(4, dtype=np.float32), 4)
ZERO, ONE, HALF, FOUR = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(4.0)
STATE = (1 + CHANNELS) * LANES
"""Transmittance and channels of a block."""
FORWARD_CHUNK = 32
BACKWARD_CHUNK = 16


@kernel
def forward(  # type: ignore[no-untyped-def]
    records, tile_start, listed_rank, row_order, lane_x, lane_y, image, transmittance
):
    """Blend every tile.

    Args:
        records: float32 [16 G], by depth rank.
        tile_start: [t + 1].
        listed_rank: int32 [P].
        row_order: The rows of tiles in the order in which they are taken, int64 [rows].
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        image: Written: float32 [t * 4 * CHANNELS * 16].
        transmittance: Written: what of the light behind passes, float32 [t * 4 * 16].
    """
    columns = (len(tile_start) - 1) // len(row_order)
    for place in parallel_range(len(tile_start) - 1):
        row, column = row_order[place // columns], place % columns
        tile = row * columns + column
        px = add(load(lane_x, 0), splat(np.float32(TILE * column + HALF)))
        py = add(load(lane_y, 0), splat(np.float32(TILE * row + HALF)))
        _forward_tile(
            records, listed_rank, tile_start[tile], tile_start[tile + 1], tile, px, py,
            image, transmittance,
        )  # fmt: skip


@always_inline
def _forward_tile(records, listed_rank, first, last, tile, px, py, image, transmittance):
    chunk, lowest = FORWARD_CHUNK, splat(LOWEST)
    right, below = add(px, splat(FOUR)), add(py, splat(FOUR))
    h, state = _aligned(BLOCKS * chunk * LANES), _aligned(BLOCKS * STATE)
    met = np.empty(BLOCKS * chunk, np.int64)
    _clear(state)
    for start in range(first, last, chunk):
        n0 = n1 = n2 = n3 = 0
        for entry in range(start, min(start + chunk, last)):
            r = RECORD * np.int64(listed_rank[entry])
            h0, h1, h2, h3 = _exponents(records, r, px, right, py, below)
            # Written in any case, and written over by the next where the block is not met.
            met[n0] = met[chunk + n1] = met[2 * chunk + n2] = met[3 * chunk + n3] = r
            store(h, LANES * n0, h0)
            store(h, LANES * (chunk + n1), h1)
            store(h, LANES * (2 * chunk + n2), h2)
            store(h, LANES * (3 * chunk + n3), h3)
            n0 += np.int64(any_greater(h0, lowest))
            n1 += np.int64(any_greater(h1, lowest))
            n2 += np.int64(any_greater(h2, lowest))
            n3 += np.int64(any_greater(h3, lowest))
        goes_on = _blend_block(records, met, h, 0, n0, state)
        goes_on |= _blend_block(records, met, h, 1, n1, state)
        goes_on |= _blend_block(records, met, h, 2, n2, state)
        goes_on |= _blend_block(records, met, h, 3, n3, state)
        if not goes_on:
            break
    for q in range(BLOCKS):
        block = BLOCKS * tile + q
        passing = negative_magnitude(load(state, STATE * q))
        store(transmittance, LANES * block, subtract(splat(ZERO), passing))
        for channel in range(CHANNELS):
            color = load(state, STATE * q + LANES * (1 + channel))
            store(image, LANES * (CHANNELS * block + channel), color)


@always_inline
def _clear(state):
    """All light passes, and nothing is seen yet."""
    for q in range(BLOCKS):
        store(state, STATE * q, splat(ONE))
        for channel in range(CHANNELS):
            store(state, STATE * q + LANES * (1 + channel), splat(ZERO))


@always_inline
def _blend_block(records, met, h, q, count, state):
    """Blend what meets block q; returns whether light still passes somewhere."""
    zero, stop = splat(ZERO), splat(STOP)
    base, first = STATE * q, FORWARD_CHUNK * q
    passing = load(state, base)
    c0, c1 = load(state, base + LANES), load(state, base + 2 * LANES)
    c2, c3 = load(state, base + 3 * LANES), load(state, base + 4 * LANES)
    for entry in range(first, first + count):
        r = met[entry]
        gained = multiply(passing, _alpha(load(h, LANES * entry), splat(records[r + 5])))
        rest = subtract(passing, gained)
        gained = select_greater(rest, stop, gained, zero)
        passing = select_greater(rest, stop, rest, negative_magnitude(passing))
        c0 = fma(gained, splat(records[r + 7]), c0)
        c1 = fma(gained, splat(records[r + 8]), c1)
        c2 = fma(gained, splat(records[r + 9]), c2)
        c3 = fma(gained, splat(records[r + 10]), c3)
    store(state, base, passing)
    store(state, base + LANES, c0)
    store(state, base + 2 * LANES, c1)
    store(state, base + 3 * LANES, c2)
    store(state, base + 4 * LANES, c3)
    return any_greater(passing, zero)


@inline
def _aligned(size):
    """A float32 array that begins at a multiple of 64 bytes."""
    array = np.empty(size + LANES, np.float32)
    first = -(array.ctypes.data // 4) % LANES
    return array[first : first + size]


@always_inline
def _exponents(records, r, left, right, above, below):
    """The h of a Gaussian at the pixels of a tile's four blocks."""
    mean_x, mean_y = splat(records[r]), splat(records[r + 1])
    a, b, c = splat(records[r + 2]), splat(records[r + 3]), splat(records[r + 4])
    dx0, dx1 = subtract(mean_x, left), subtract(mean_x, right)
    dy0, dy1 = subtract(mean_y, above), subtract(mean_y, below)
    top = splat(records[r + 5])
    y0, y1 = fma(multiply(c, dy0), dy0, top), fma(multiply(c, dy1), dy1, top)
    x0, x1, cross0, cross1 = multiply(a, dx0), multiply(a, dx1), multiply(b, dy0), multiply(b, dy1)
    return (
        fma(add(x0, cross0), dx0, y0),
        fma(add(x1, cross0), dx1, y0),
        fma(add(x0, cross1), dx0, y1),
        fma(add(x1, cross1), dx1, y1),
    )


@always_inline
def _alpha(h, top):
    """Alpha where it counts (sigma >= 0, alpha >= 1/255), else 0."""
    zero = splat(ZERO)
    alpha = minimum(exp_of_eighth(minimum(h, zero)), splat(MAX_ALPHA))
    alpha = select_greater(h, splat(LOWEST), alpha, zero)
    return select_greater(h, top, zero, alpha)


@kernel
def backward(
    records, tile_start, listed_rank, listed_slot, row_order, lane_x, lane_y, gradient, behind,
    absolute, sums,
):  # fmt: skip
    """Gradients of every pair.

    Args:
        records: As in ``forward``.
        tile_start: As in ``forward``.
        listed_rank: As in ``forward``.
        listed_slot: int32 [P].
        row_order: As in ``forward``.
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        gradient: d loss / d image, block image, float32 [t * 4 * CHANNELS * 16].
        behind: gradient . final colour - (d loss / d alpha) T_final, float32 [t * 4 * 16]; used up.
        absolute: Whether the absolute gradients of the means are wanted; else they are 0.
        sums: Written: float32 [16 P] by slot; pairs that are not reached must hold 0.
    """
    columns = (len(tile_start) - 1) // len(row_order)
    for place in parallel_range(len(tile_start) - 1):
        row, column = row_order[place // columns], place % columns
        tile = row * columns + column
        px = add(load(lane_x, 0), splat(np.float32(TILE * column + HALF)))
        py = add(load(lane_y, 0), splat(np.float32(TILE * row + HALF)))
        _backward_tile(
            records, listed_rank, listed_slot, tile_start[tile], tile_start[tile + 1],
            BLOCKS * tile, px, py, gradient, behind, absolute, sums,
        )  # fmt: skip


@always_inline
def _backward_tile(
    records, listed_rank, listed_slot, first, last, block, px, py, gradient, behind, absolute, sums
):
    right, below = add(px, splat(FOUR)), add(py, splat(FOUR))
    h, passing = _aligned(BLOCKS * BACKWARD_CHUNK * LANES), _aligned(BLOCKS * LANES)
    met, lowest = np.empty(BACKWARD_CHUNK, np.int64), splat(LOWEST)
    for q in range(BLOCKS):
        store(passing, LANES * q, splat(ONE))
    for start in range(first, last, BACKWARD_CHUNK):
        g0, g1 = _goes_on(passing, 0), _goes_on(passing, 1)
        g2, g3 = _goes_on(passing, 2), _goes_on(passing, 3)
        if not g0 | g1 | g2 | g3:
            break
        stop = min(start + BACKWARD_CHUNK, last)
        for entry in range(start, stop):
            i = entry - start
            r = RECORD * np.int64(listed_rank[entry])
            h0, h1, h2, h3 = _exponents(records, r, px, right, py, below)
            store(h, LANES * BLOCKS * i, h0)
            store(h, LANES * (BLOCKS * i + 1), h1)
            store(h, LANES * (BLOCKS * i + 2), h2)
            store(h, LANES * (BLOCKS * i + 3), h3)
            met[i] = (
                (g0 & np.int64(any_greater(h0, lowest)))
                | (g1 & np.int64(any_greater(h1, lowest))) << 1
                | (g2 & np.int64(any_greater(h2, lowest))) << 2
                | (g3 & np.int64(any_greater(h3, lowest))) << 3
            )
        for entry in range(start, stop):
            i = entry - start
            if met[i]:
                _backward_pair(
                    records, RECORD * np.int64(listed_rank[entry]), met[i], h, BLOCKS * i, block,
                    px, py, gradient, behind, passing, absolute, sums,
                    SUMS * np.int64(listed_slot[entry]),
                )  # fmt: skip


@always_inline
def _goes_on(passing, q):
    """1 if light still passes somewhere in block q, else 0."""
    return np.int64(any_greater(load(passing, LANES * q), splat(ZERO)))


@always_inline
def _backward_pair(
    records, r, met, h, first, block, px, py, gradient, behind, passing, absolute, sums, slot
):
    """The sums of one Gaussian over those of a tile's blocks that it meets (bits of ``met``)."""
    zero = splat(ZERO)
    p, px1, py1, pxx, pxy, pyy = zero, zero, zero, zero, zero, zero
    g0, g1, g2, g3, ax, ay = zero, zero, zero, zero, zero, zero
    mean_x, mean_y = subtract(splat(records[r]), px), subtract(splat(records[r + 1]), py)
    for q in range(BLOCKS):
        if met >> q & 1:
            dx = subtract(mean_x, splat(np.float32(4 * (q % 2))))
            dy = subtract(mean_y, splat(np.float32(4 * (q // 2))))
            t, base = load(passing, LANES * q), CHANNELS * LANES * (block + q)
            alpha = _alpha(load(h, LANES * (first + q)), splat(records[r + 5]))
            gained = multiply(t, alpha)
            rest = subtract(t, gained)
            gained = select_greater(rest, splat(STOP), gained, zero)
            t_next = select_greater(rest, splat(STOP), rest, negative_magnitude(t))
            store(passing, LANES * q, t_next)
            v0, v1 = load(gradient, base), load(gradient, base + LANES)
            v2, v3 = load(gradient, base + 2 * LANES), load(gradient, base + 3 * LANES)
            shade = multiply(v0, splat(records[r + 7]))
            shade = fma(v1, splat(records[r + 8]), shade)
            shade = fma(v2, splat(records[r + 9]), shade)
            shade = fma(v3, splat(records[r + 10]), shade)
            far = subtract(load(behind, LANES * (block + q)), multiply(gained, shade))
            store(behind, LANES * (block + q), far)
            g0, g1 = fma(gained, v0, g0), fma(gained, v1, g1)
            g2, g3 = fma(gained, v2, g2), fma(gained, v3, g3)
            slope = subtract(divide(far, subtract(splat(ONE), alpha)), multiply(t, shade))
            push = select_greater(gained, zero, multiply(slope, alpha), zero)
            # A clamped alpha is constant.
            push = select_greater(splat(MAX_ALPHA), alpha, push, zero)
            along_x, along_y = multiply(push, dx), multiply(push, dy)
            p, px1, py1 = add(p, push), add(px1, along_x), add(py1, along_y)
            pxx, pyy = fma(along_x, dx, pxx), fma(along_y, dy, pyy)
            pxy = fma(along_x, dy, pxy)
            if absolute:
                step_x, step_y = _steps(records, r, along_x, along_y)
                ax = subtract(ax, negative_magnitude(step_x))
                ay = subtract(ay, negative_magnitude(step_y))
    vectors = (p, px1, py1, pxx, pxy, pyy, g0, g1, g2, g3, ax, ay, zero, zero, zero, zero)
    store(sums, slot, lane_sums(vectors))


@always_inline
def _steps(records, r, along_x, along_y):
    """What each pixel adds to d mean x and d mean y."""
    a, b = splat(np.float32(-16.0) * records[r + 2]), splat(np.float32(-8.0) * records[r + 3])
    c = splat(np.float32(-16.0) * records[r + 4])
    return fma(a, along_x, multiply(b, along_y)), fma(b, along_x, multiply(c, along_y))


@kernel
def sum_pairs(slot_start, sums, totals):
    """Add up each Gaussian's pairs in slot order: [16 P] by slot to [G, 16] by depth rank."""
    for g in parallel_range(len(totals)):
        total = splat(ZERO)
        for slot in range(slot_start[g], slot_start[g + 1]):
            total = add(total, load(sums, SUMS * slot))
        store(totals[g], 0, total)
