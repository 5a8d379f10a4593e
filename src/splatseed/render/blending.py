"""Front-to-back blending of Gaussians into pixels, forward and backward.

Specification (``reference.py`` is its readable form): over the Gaussians of a pixel, nearest first,
sigma = (a dx^2 + c dy^2) / 2 + b dx dy, alpha = min(0.999, opacity exp(-sigma)); those with sigma < 0
or alpha < 1/255 are skipped; blending ends before the Gaussian that would bring the transmittance T
to 1e-4 or less; colour += alpha T c, T <- T (1 - alpha).

Stages: a tile's 64 pixels are four blocks of 4 x 4, one vector each. Forward takes block by block and
keeps all state in registers. Backward takes Gaussian by Gaussian, so that the sums over pixels are
formed once per tile, and walks front to back again: with the image known, what lies behind a Gaussian
is what the image has less what has been blended so far, so nothing need be stored. Each pair has a
place of its own for its sums, added up per Gaussian in a fixed order afterwards: no atomics, the same
bytes every time.

Arrays: a *record* of a Gaussian is 16 float32: mean x, y; conic a, b, c; opacity; -reach; four
channels; rest 0. A block image is [tiles, 4 blocks, channels, 16 lanes].
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np

from splatseed.jit import always_inline, kernel, parallel_range
from splatseed.render.binning import TILE
from splatseed.render.simd import (
    LANES,
    add,
    any_greater,
    divide,
    exp_nonpositive,
    fma,
    lane_sums,
    load,
    minimum,
    multiply,
    select_greater,
    splat,
    store,
    subtract,
)

__all__ = ["BLOCKS", "CHANNELS", "RECORD", "backward", "forward", "sum_pairs"]

CHANNELS = 4
RECORD = 16
BLOCKS = 4
SUMS = 16
"""Numbers per pair: d mean x, y; d conic a, b, c; d opacity; d channels; |d mean x|, |d mean y|."""
STOP = np.float32(1e-4)
MAX_ALPHA = np.float32(0.999)
COLUMN = np.tile(np.arange(4, dtype=np.float32), 4)
ROW = np.repeat(np.arange(4, dtype=np.float32), 4)
ZERO, ONE, HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@kernel
def forward(  # type: ignore[no-untyped-def]
    records, tile_start, listed_rank, columns, lane_x, lane_y, image, transmittance
):
    """Blend every tile.

    Args:
        records: float32 [16 G], by depth rank.
        tile_start: [t + 1].
        listed_rank: int32 [P].
        columns: Tiles in a row.
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        image: Written: float32 [t * 4 * CHANNELS * 16].
        transmittance: Written: what of the light behind passes, float32 [t * 4 * 16].
    """
    for tile in parallel_range(len(tile_start) - 1):
        for block in range(BLOCKS):
            x = TILE * (tile % columns) + 4 * (block % 2)
            y = TILE * (tile // columns) + 4 * (block // 2)
            _forward_block(
                records, listed_rank, tile_start[tile], tile_start[tile + 1],
                add(load(lane_x, 0), splat(np.float32(x + HALF))),
                add(load(lane_y, 0), splat(np.float32(y + HALF))),
                BLOCKS * tile + block, image, transmittance,
            )  # fmt: skip


@always_inline
def _forward_block(records, listed_rank, first, last, px, py, block, image, transmittance):
    zero, stop = splat(ZERO), splat(STOP)
    c0, c1, c2, c3 = zero, zero, zero, zero
    passing, frozen = splat(ONE), zero  # T of pixels that go on, and of those that are done
    for entry in range(first, last):
        r = RECORD * np.int64(listed_rank[entry])
        dx, dy = subtract(splat(records[r]), px), subtract(splat(records[r + 1]), py)
        h = _exponent(records, r, dx, dy)
        lowest = splat(records[r + 6])
        if any_greater(h, lowest):
            raw = multiply(splat(records[r + 5]), _falloff(h, lowest))
            gained = multiply(passing, _alpha(raw, h, lowest))
            rest = subtract(passing, gained)
            gained = select_greater(rest, stop, gained, zero)
            frozen = select_greater(rest, stop, frozen, add(frozen, passing))
            passing = select_greater(rest, stop, rest, zero)
            c0 = fma(gained, splat(records[r + 7]), c0)
            c1 = fma(gained, splat(records[r + 8]), c1)
            c2 = fma(gained, splat(records[r + 9]), c2)
            c3 = fma(gained, splat(records[r + 10]), c3)
            if not any_greater(passing, zero):
                break
    base = CHANNELS * LANES * block
    store(image, base, c0)
    store(image, base + LANES, c1)
    store(image, base + 2 * LANES, c2)
    store(image, base + 3 * LANES, c3)
    store(transmittance, LANES * block, add(passing, frozen))


@always_inline
def _exponent(records, r, dx, dy):
    """-sigma of a Gaussian at sixteen pixels."""
    a, b, c = splat(records[r + 2]), splat(records[r + 3]), splat(records[r + 4])
    square = fma(multiply(a, dx), dx, multiply(multiply(c, dy), dy))
    return subtract(multiply(splat(-HALF), square), multiply(multiply(b, dx), dy))


@always_inline
def _falloff(h, lowest):
    """exp(h), finite also where h is below what counts."""
    held = select_greater(h, lowest, h, lowest)
    return exp_nonpositive(minimum(held, splat(ZERO)))


@always_inline
def _alpha(raw, h, lowest):
    """Alpha where it counts (sigma >= 0, alpha >= 1/255), else 0."""
    zero = splat(ZERO)
    alpha = select_greater(h, lowest, minimum(raw, splat(MAX_ALPHA)), zero)
    return select_greater(h, zero, zero, alpha)


@kernel
def backward(
    records, tile_start, listed_rank, listed_slot, columns, lane_x, lane_y, gradient, behind, sums
):
    """Gradients of every pair.

    Args:
        records: As in ``forward``.
        tile_start: As in ``forward``.
        listed_rank: As in ``forward``.
        listed_slot: int32 [P].
        columns: Tiles in a row.
        lane_x: ``COLUMN``.
        lane_y: ``ROW``.
        gradient: d loss / d image, block image, float32 [t * 4 * CHANNELS * 16].
        behind: gradient . final colour - (d loss / d alpha) T_final, float32 [t * 4 * 16]; used up.
        sums: Written: float32 [16 P] by slot; pairs that are not reached must hold 0.
    """
    for tile in parallel_range(len(tile_start) - 1):
        passing = np.ones(BLOCKS * LANES, np.float32)
        x, y = TILE * (tile % columns), TILE * (tile // columns)
        for entry in range(tile_start[tile], tile_start[tile + 1]):
            open_blocks = _backward_pair(
                records, RECORD * np.int64(listed_rank[entry]), SUMS * np.int64(listed_slot[entry]),
                BLOCKS * tile, x, y, lane_x, lane_y, gradient, behind, passing, sums,
            )  # fmt: skip
            if not open_blocks:
                break


@always_inline
def _backward_pair(records, r, slot, block, x, y, lane_x, lane_y, gradient, behind, passing, sums):
    """Add one Gaussian to a tile's four blocks; returns whether light still passes somewhere."""
    zero = splat(ZERO)
    gx, gy, ga, gb, gc, go = zero, zero, zero, zero, zero, zero
    g0, g1, g2, g3, ax, ay = zero, zero, zero, zero, zero, zero
    touched = passes = False
    mean_x, mean_y = (
        splat(records[r] - np.float32(x) - HALF),
        splat(records[r + 1] - np.float32(y) - HALF),
    )
    lowest = splat(records[r + 6])
    for q in range(BLOCKS):
        px = add(load(lane_x, 0), splat(np.float32(4 * (q % 2))))
        py = add(load(lane_y, 0), splat(np.float32(4 * (q // 2))))
        t = load(passing, LANES * q)
        dx, dy = subtract(mean_x, px), subtract(mean_y, py)
        h = _exponent(records, r, dx, dy)
        if any_greater(t, zero):
            passes = True
            if any_greater(h, lowest):
                touched = True
                falloff = _falloff(h, lowest)
                raw = multiply(splat(records[r + 5]), falloff)
                alpha = _alpha(raw, h, lowest)
                gained = multiply(t, alpha)
                rest = subtract(t, gained)
                gained = select_greater(rest, splat(STOP), gained, zero)
                store(passing, LANES * q, select_greater(rest, splat(STOP), rest, zero))
                base = CHANNELS * LANES * (block + q)
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
                slope = subtract(multiply(t, shade), divide(far, subtract(splat(ONE), alpha)))
                slope = select_greater(gained, zero, slope, zero)
                # A clamped alpha is constant.
                slope = select_greater(raw, splat(MAX_ALPHA), zero, slope)
                push = multiply(slope, subtract(zero, raw))  # d loss / d sigma
                go = fma(slope, falloff, go)
                along_x, along_y = multiply(push, dx), multiply(push, dy)
                ga, gc = fma(along_x, dx, ga), fma(along_y, dy, gc)
                gb = fma(along_x, dy, gb)
                a, b, c = splat(records[r + 2]), splat(records[r + 3]), splat(records[r + 4])
                step_x = fma(a, along_x, multiply(b, along_y))
                step_y = fma(b, along_x, multiply(c, along_y))
                gx, gy = add(gx, step_x), add(gy, step_y)
                ax = add(ax, select_greater(step_x, zero, step_x, subtract(zero, step_x)))
                ay = add(ay, select_greater(step_y, zero, step_y, subtract(zero, step_y)))
    if touched:
        half = splat(HALF)
        ga, gc = multiply(ga, half), multiply(gc, half)
        row = lane_sums((gx, gy, ga, gb, gc, go, g0, g1, g2, g3, ax, ay, zero, zero, zero, zero))
        store(sums, slot, row)
    return passes


@kernel
def sum_pairs(slot_start, sums, totals):
    """Add up each Gaussian's pairs in slot order: [16 P] by slot to [G, 16] by depth rank."""
    for g in parallel_range(len(totals)):
        total = splat(ZERO)
        for slot in range(slot_start[g], slot_start[g + 1]):
            total = add(total, load(sums, SUMS * slot))
        store(totals[g], 0, total)
