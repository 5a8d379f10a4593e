"""Compute view-dependent colours by spherical harmonics, and their gradient.

colour = max(0, 1/2 + sum_k y_k(d) h_k) for each channel, with d = (x, y, z) the unit direction from
the camera to the Gaussian. ``rendering.harmonics`` has the basis functions y_k, the notation
(factor, form, row) and the tables. Lane k of a vector holds function k. Directions are normalised
in float64; all else is float32.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.rendering.harmonics import CHANNELS, FIRST, FORM, ROW, USED, Y0, coefficient_index
from splatseed.runtime.jit import always_inline, kernel, parallel_range
from splatseed.runtime.simd import (
    LANES,
    add,
    broadcast,
    fma,
    lane,
    load,
    multiply,
    permutation,
    prefetch,
    select_greater,
    store,
    three_sums,
    triple,
)

CHUNKS = 64
"""Parts of the Gaussians that are processed in parallel."""
PREFETCH = 10
"""Distance of prefetching, rows: skipped rows of invisible Gaussians defeat the hardware's own."""
BASE = np.float32(Y0)
# From lane k, y_k, to the lanes of each vector of a row that hold the coefficient h_k.
spread_0, spread_1, spread_2 = (
    permutation([coefficient_index(first + j) for j in range(LANES)]) for first in FIRST
)
# From lanes 0 to 2 (red, green, blue) to the channels of a row's vectors; two of them coincide.
channels_01, channels_2 = (
    permutation([(first + j) % CHANNELS for j in range(LANES)]) for first in FIRST[1:]
)
later_1, later_3, later_6, later_12 = (
    permutation([(j + step) % LANES for j in range(LANES)]) for step in (1, 3, 6, 12)
)
lane_0, lane_1, lane_2, lane_4, lane_8 = map(lane, (0, 1, 2, 4, 8))


@kernel
def harmonics(means, origin, base, rest, skipped, radii, table, colors):
    """Compute the colours of N Gaussians: max(0, 1/2 + sum_k y_k h_k).

    Args:
        means: float32 [N, 3].
        origin: The camera's centre, float32 [3].
        base: First coefficients, float32 [N, 1 or 16, 3].
        rest: Rows, ``skipped`` numbers before each, float32 [N (skipped + 45)].
        skipped: 0 or 3.
        radii: int32 [N, 2]; a Gaussian with a radius of 0 gets the colour 0.
        table: The entry of ``TABLES`` for the degree.
        colors: Written, float32 [N, 3].
    """
    for chunk in parallel_range(CHUNKS):
        for i in range(chunk * len(means) // CHUNKS, (chunk + 1) * len(means) // CHUNKS):
            if radii[i, 0] > 0 and radii[i, 1] > 0:
                x, y, z = _offset(means, origin, i)
                inverse = 1.0 / _length(x, y, z)
                x, y, z = x * inverse, y * inverse, z * inverse
                factor, form = _basis(*_vectors(x, y, z), table)
                basis = multiply(factor, form)
                _prefetch(rest, (i + PREFETCH) * (skipped + ROW))
                # sum_k y_k h_k over k >= 1, one channel in each of lanes 0 to 2
                # A row is r g b r g b ...: lane j of vector v has channel (FIRST[v] + j) % 3.
                a, b, c = _row(rest, i * (skipped + ROW) + skipped, table)
                total = fma(spread_1(basis), b, multiply(spread_0(basis), a))
                # The third vector starts at number 29, channel 2: shift it by a lane.
                total = _by_channel(add(total, later_1(multiply(spread_2(basis), c))))
                colors[i, 0] = _shade(base[i, 0, 0], lane_0(total))
                colors[i, 1] = _shade(base[i, 0, 1], lane_1(total))
                colors[i, 2] = _shade(base[i, 0, 2], lane_2(total))
            else:
                colors[i, 0] = colors[i, 1] = colors[i, 2] = np.float32(0.0)


@kernel
def harmonics_vjp(
    means, origin, rest, skipped, radii, table, colors, d_colors, d_means, d_base, d_rest
):
    """Compute the gradients of ``harmonics``.

    Args:
        means: As in ``harmonics``; likewise all up to ``colors``.
        origin: [3].
        rest: [N (skipped + 45)].
        skipped: 0 or 3.
        radii: [N, 2].
        table: [224].
        colors: Result of ``harmonics``, [N, 3].
        d_colors: d loss / d colors, float32 [N, 3].
        d_means: Written, float32 [N, 3].
        d_base: Written, float32 like ``base``, first coefficients only.
        d_rest: Written, float32 like ``rest``, rows only.
    """
    for chunk in parallel_range(CHUNKS):
        for i in range(chunk * len(means) // CHUNKS, (chunk + 1) * len(means) // CHUNKS):
            red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            dx = dy = dz = 0.0
            row = i * (skipped + ROW) + skipped
            if radii[i, 0] > 0 and radii[i, 1] > 0:
                red = _unless_clamped(d_colors[i, 0], colors[i, 0])
                green = _unless_clamped(d_colors[i, 1], colors[i, 1])
                blue = _unless_clamped(d_colors[i, 2], colors[i, 2])
                x, y, z = _offset(means, origin, i)
                inverse = 1.0 / _length(x, y, z)
                x, y, z = x * inverse, y * inverse, z * inverse
                _prefetch(rest, row + PREFETCH * (skipped + ROW))
                _prefetch(d_rest, row + PREFETCH * (skipped + ROW))
                d_color = triple(red, green, blue)
                gradients = _row_vjp(*_vectors(x, y, z), d_color, rest, row, table, d_rest)
                dx, dy, dz = lane_0(gradients), lane_4(gradients), lane_8(gradients)
                # d (v / |v|) = (I - d d') / |v|
                along = dx * x + dy * y + dz * z
                dx, dy = (dx - along * x) * inverse, (dy - along * y) * inverse
                dz = (dz - along * z) * inverse
            else:
                zero = broadcast(np.float32(0.0))
                # The gradients of invisible Gaussians must be 0.
                store(d_rest, row + FIRST[0], zero)
                store(d_rest, row + FIRST[1], zero)
                store(d_rest, row + FIRST[2], zero)
            d_means[i, 0], d_means[i, 1], d_means[i, 2] = dx, dy, dz
            d_base[i, 0, 0], d_base[i, 0, 1], d_base[i, 0, 2] = (
                BASE * red,
                BASE * green,
                BASE * blue,
            )


@always_inline
def _offset(means, origin, i):
    """Return the vector from the camera to a Gaussian, float64."""
    return (
        np.float64(means[i, 0] - origin[0]), np.float64(means[i, 1] - origin[1]),
        np.float64(means[i, 2] - origin[2]),
    )  # fmt: skip


@always_inline
def _length(x, y, z):
    # At least 1e-12: a Gaussian at the camera's centre must not divide by 0.
    return max(math.sqrt(x * x + y * y + z * z), 1e-12)


@always_inline
def _vectors(x, y, z):
    return broadcast(np.float32(x)), broadcast(np.float32(y)), broadcast(np.float32(z))


@always_inline
def _basis(x, y, z, table):
    """Compute factor and form of the basis functions, y_k = factor_k form_k, k the lane."""
    # factor = f0 + f1 x + f2 y + f3 z, one of the f being 1
    factor = fma(load(table, LANES), x, load(table, 0))
    factor = fma(load(table, 3 * LANES), z, fma(load(table, 2 * LANES), y, factor))
    # form = c0 + c1 xx + c2 yy + c3 zz + c4 xy + c5 yz + c6 xz
    form = fma(load(table, FORM + LANES), multiply(x, x), load(table, FORM))
    form = fma(load(table, FORM + 2 * LANES), multiply(y, y), form)
    form = fma(load(table, FORM + 3 * LANES), multiply(z, z), form)
    form = fma(load(table, FORM + 4 * LANES), multiply(x, y), form)
    form = fma(load(table, FORM + 5 * LANES), multiply(y, z), form)
    return factor, fma(load(table, FORM + 6 * LANES), multiply(x, z), form)


@always_inline
def _prefetch(rows, row):
    for line in range(0, ROW, LANES):
        prefetch(rows, row + line)


@always_inline
def _row(rest, row, table):
    """Load a row's three vectors, with unused and repeated numbers (even NaN) set to 0."""
    return (
        _keep_used(load(rest, row + FIRST[0]), load(table, USED)),
        _keep_used(load(rest, row + FIRST[1]), load(table, USED + LANES)),
        _keep_used(load(rest, row + FIRST[2]), load(table, USED + 2 * LANES)),
    )


@always_inline
def _keep_used(v, used):
    zero = broadcast(np.float32(0.0))
    return select_greater(used, zero, v, zero)


@always_inline
def _by_channel(v):
    """Return the sums of lanes 0, 3, ..., 12, of 1, 4, ... and of 2, 5, ... in lanes 0 to 2."""
    # Lanes j, j + 3, j + 6, j + 9 by two additions, then j + 12; lane 15 is padding.
    pairs = add(v, later_6(v))
    return add(add(pairs, later_3(pairs)), later_12(v))


@always_inline
def _shade(base, others):
    """Return max(0, 1/2 + y_0 h_0 + others); NaN stays NaN, and blending skips the Gaussian."""
    shade = (BASE * base + others) + np.float32(0.5)
    return np.float32(0.0) if shade < np.float32(0.0) else shade  # noqa: FURB136  (NaN)


@always_inline
def _unless_clamped(d_color, color):
    """Return the gradient of a colour, 0 if the colour was clamped to 0."""
    return d_color if color > np.float32(0.0) else np.float32(0.0)


@always_inline
def _row_vjp(x, y, z, d_color, rest, row, table, d_rest):
    """Write d h = y d_color; return d loss / d (x, y, z) in lanes 0, 4 and 8."""
    factor, form = _basis(x, y, z, table)
    basis = multiply(factor, form)
    red_first, blue_first = channels_01(d_color), channels_2(d_color)
    store(d_rest, row + FIRST[0], multiply(spread_0(basis), red_first))
    store(d_rest, row + FIRST[1], multiply(spread_1(basis), red_first))
    store(d_rest, row + FIRST[2], multiply(spread_2(basis), blue_first))
    a, b, c = _row(rest, row, table)
    a, b, c = multiply(a, red_first), multiply(b, red_first), multiply(c, blue_first)
    # 2 x, 2 y and 2 z, the derivatives of the squares.
    xx, yy, zz = add(x, x), add(y, y), add(z, z)
    by_x = _derivative(xx, y, z, FORM + LANES, FORM + 4 * LANES, FORM + 6 * LANES, table)
    by_y = _derivative(yy, x, z, FORM + 2 * LANES, FORM + 4 * LANES, FORM + 5 * LANES, table)
    by_z = _derivative(zz, y, x, FORM + 3 * LANES, FORM + 5 * LANES, FORM + 6 * LANES, table)
    # d y_k / dx = (d factor_k / dx) form_k + factor_k (d form_k / dx); likewise y and z
    return three_sums(
        _weighted(fma(load(table, LANES), form, multiply(factor, by_x)), a, b, c),
        _weighted(fma(load(table, 2 * LANES), form, multiply(factor, by_y)), a, b, c),
        _weighted(fma(load(table, 3 * LANES), form, multiply(factor, by_z)), a, b, c),
    )


@always_inline
def _derivative(twice, one, other, square, with_one, with_other, table):
    """Differentiate the forms along an axis, through its square and its two products."""
    # d form / dx = 2 c1 x + c4 y + c6 z, and likewise for the other axes
    products = fma(load(table, with_one), one, multiply(load(table, with_other), other))
    return fma(load(table, square), twice, products)


@always_inline
def _weighted(gradients, a, b, c):
    """Multiply derivatives of the y_k by a row; the sum over lanes is left to the caller."""
    total = fma(spread_1(gradients), b, multiply(spread_0(gradients), a))
    return fma(spread_2(gradients), c, total)
