"""View-dependent colour: real spherical harmonics up to degree 3, and their gradient.

Basis, order and signs are those of 3D Gaussian Splatting and gsplat (P.-P. Sloan, Efficient
Spherical Harmonic Evaluation, 2013). The direction runs from the camera to the Gaussian and is
normalised here.

colour = max(0, 1/2 + sum_k y_k(d) h_k) for each channel, d the unit direction (x, y, z).

Notation: every basis function y_k is a *factor* (1, x, y or z) times a *form*, c0 + c1 xx + c2 yy +
c3 zz + c4 xy + c5 yz + c6 xz: lane k of a vector holds function k. A *row* is the 45 coefficients
of a Gaussian beyond the first of each channel, 15 times red, green, blue; it is read as three
overlapping vectors that start at ``FIRST``. Directions are normalised in float64, the rest is
float32.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import always_inline, kernel, parallel_range
from splatseed.runtime.shuffles import lane, permutation, three_sums, triple
from splatseed.runtime.simd import (
    LANES,
    add,
    broadcast,
    fma,
    load,
    multiply,
    prefetch,
    select_greater,
    store,
)

MAX_DEGREE = 3
TERMS = 16
"""Basis functions of degree 3: 1 + 3 + 5 + 7; also the lanes of a vector."""
CHANNELS = 3
ROW = 45
"""Coefficients of a row: 15 functions beyond the first, 3 channels each."""
CHUNKS = 64
"""Pieces of work for the threads."""
AHEAD = 10
"""How many rows ahead memory is prefetched: rows of invisible Gaussians are skipped, and skips
defeat the hardware's own prefetching."""
FIRST = (0, 15, 29)
"""Where in a row its three vectors of 16 begin; the last one ends with the row."""
PART = 15
"""How many numbers each vector contributes; its overlap with another counts once."""
# Y0 = sqrt(1 / (4 pi)), Y1 = sqrt(3 / (4 pi)), Y2A = sqrt(15 / (4 pi)), Y2B = 3 Y2D,
# Y2D = sqrt(5 / (16 pi)), Y2C = Y2A / 2; degree 3 likewise.
Y0 = np.float32(0.2820947917738781)
Y1 = 0.48860251190292
Y2A, Y2B, Y2C = 1.0925484305920792, 0.9461746957575601, 0.5462742152960396
Y2D = 0.3153915652525201
Y3A, Y3B, Y3C = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
Y3D, Y3E = 0.3731763325901154, 1.445305721320277
FUNCTIONS: tuple[tuple[str, dict[str, float]], ...] = (
    # y_0, degree 0
    ("1", {"1": float(Y0)}),
    # y_1 to y_3, degree 1
    ("y", {"1": -Y1}),
    ("z", {"1": Y1}),
    ("x", {"1": -Y1}),
    # y_4 to y_8, degree 2
    ("1", {"xy": Y2A}),
    ("1", {"yz": -Y2A}),
    ("1", {"zz": Y2B, "1": -Y2D}),
    ("1", {"xz": -Y2A}),
    ("1", {"xx": Y2C, "yy": -Y2C}),
    # y_9 to y_15, degree 3
    ("y", {"xx": -3.0 * Y3A, "yy": Y3A}),
    ("z", {"xy": Y3B}),
    ("y", {"zz": -5.0 * Y3C, "1": Y3C}),
    ("z", {"zz": 5.0 * Y3D, "1": -3.0 * Y3D}),
    ("x", {"zz": -5.0 * Y3C, "1": Y3C}),
    ("z", {"xx": Y3E, "yy": -Y3E}),
    ("x", {"xx": -Y3A, "yy": 3.0 * Y3A}),
)
"""Factor and form of the basis functions, one per lane."""
FACTORS, FORMS = ("1", "x", "y", "z"), ("1", "xx", "yy", "zz", "xy", "yz", "xz")
FORM, LIVE = LANES * len(FACTORS), LANES * (len(FACTORS) + len(FORMS))
"""Offsets in a table. Its rows of 16 lanes: factors 1, x, y, z; the form's coefficients of 1, xx,
yy, zz, xy, yz, xz, from FORM on; and three rows of marks, from LIVE on, of which lanes count."""


def _coefficient_of(number: int) -> int:
    """The index k of the coefficient that a number of a row is a channel of."""
    return 1 + number // CHANNELS


def _table(degree: int) -> np.ndarray:
    """The table of a degree, flat: factors, forms, and which lanes of a row's vectors count."""
    terms = (degree + 1) ** 2
    table = np.zeros((len(FACTORS) + len(FORMS) + len(FIRST), LANES), np.float32)
    for k, (factor, form) in enumerate(FUNCTIONS[:terms]):
        table[FACTORS.index(factor), k] = 1.0
        for name, value in form.items():
            table[len(FACTORS) + FORMS.index(name), k] = value
    for part, first in enumerate(FIRST):
        for number in range(PART * part, PART * (part + 1)):
            table[part - len(FIRST), number - first] = _coefficient_of(number) < terms
    return table.reshape(-1)


TABLES = tuple(map(_table, range(MAX_DEGREE + 1)))
"""The tables by degree, float32 [224]."""

# y_k from lane k to the three numbers of a row that it multiplies, in each of the vectors.
spread_0, spread_1, spread_2 = (
    permutation([_coefficient_of(first + j) for j in range(LANES)]) for first in FIRST
)
# Red, green, blue from lanes 0 to 2 to the channels of a row's vectors; the first two coincide.
channels_01, channels_2 = (
    permutation([(first + j) % CHANNELS for j in range(LANES)]) for first in FIRST[1:]
)
later_1, later_3, later_6, later_12 = (
    permutation([(j + step) % LANES for j in range(LANES)]) for step in (1, 3, 6, 12)
)
lane_0, lane_1, lane_2, lane_4, lane_8 = map(lane, (0, 1, 2, 4, 8))


@kernel
def harmonics(means, origin, base, rest, skipped, radii, table, colors):
    """Colours of N Gaussians: max(0, 1/2 + sum_k y_k h_k).

    Args:
        means: float32 [N, 3].
        origin: The camera's centre, float32 [3].
        base: First coefficients, float32 [N, 1 or 16, 3].
        rest: The rows one after the other, float32 [N (skipped + 45)].
        skipped: Numbers before each row.
        radii: int32 [N, 2]; where one is 0 the colour is 0.
        table: The degree's of ``TABLES``.
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
                _prefetch(rest, (i + AHEAD) * (skipped + ROW))
                # sum_k y_k h_k over k >= 1, one channel in each of lanes 0 to 2
                # A row runs r g b r g b ...: lane j of vector v is of channel (FIRST[v] + j) % 3.
                a, b, c = _row(rest, i * (skipped + ROW) + skipped, table)
                total = fma(spread_1(basis), b, multiply(spread_0(basis), a))
                # The third vector begins at number 29, channel 2: one lane on, it is in phase.
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
    """Gradients of ``harmonics``.

    Args:
        means: As in ``harmonics``, as are all up to ``colors``.
        origin: [3].
        rest: [N (skipped + 45)].
        skipped: Numbers before each row.
        radii: [N, 2].
        table: The degree's.
        colors: What ``harmonics`` wrote, [N, 3].
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
                _prefetch(rest, row + AHEAD * (skipped + ROW))
                _prefetch(d_rest, row + AHEAD * (skipped + ROW))
                d_color = triple(red, green, blue)
                gradients = _row_vjp(*_vectors(x, y, z), d_color, rest, row, table, d_rest)
                dx, dy, dz = lane_0(gradients), lane_4(gradients), lane_8(gradients)
                # d (v / |v|) = (I - d d') / |v|
                along = dx * x + dy * y + dz * z
                dx, dy = (dx - along * x) * inverse, (dy - along * y) * inverse
                dz = (dz - along * z) * inverse
            else:
                zero = broadcast(np.float32(0.0))
                # Every row is written, as gradients of unseen Gaussians must be 0.
                store(d_rest, row + FIRST[0], zero)
                store(d_rest, row + FIRST[1], zero)
                store(d_rest, row + FIRST[2], zero)
            d_means[i, 0], d_means[i, 1], d_means[i, 2] = dx, dy, dz
            d_base[i, 0, 0], d_base[i, 0, 1], d_base[i, 0, 2] = Y0 * red, Y0 * green, Y0 * blue


@always_inline
def _offset(means, origin, i):
    """The vector from the camera to a Gaussian, float64."""
    return (
        np.float64(means[i, 0] - origin[0]), np.float64(means[i, 1] - origin[1]),
        np.float64(means[i, 2] - origin[2]),
    )  # fmt: skip


@always_inline
def _length(x, y, z):
    # A Gaussian in the camera's centre has no direction, and must not divide by 0.
    return max(math.sqrt(x * x + y * y + z * z), 1e-12)


@always_inline
def _vectors(x, y, z):
    return broadcast(np.float32(x)), broadcast(np.float32(y)), broadcast(np.float32(z))


@always_inline
def _basis(x, y, z, table):
    """Factors and forms of the basis functions, y_k = factor_k form_k, one per lane."""
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
    """A row's three vectors.

    Unused and repeated numbers become 0, even if they are NaN.
    """
    return (
        _live(load(rest, row + FIRST[0]), load(table, LIVE)),
        _live(load(rest, row + FIRST[1]), load(table, LIVE + LANES)),
        _live(load(rest, row + FIRST[2]), load(table, LIVE + 2 * LANES)),
    )


@always_inline
def _live(v, marks):
    zero = broadcast(np.float32(0.0))
    return select_greater(marks, zero, v, zero)


@always_inline
def _by_channel(v):
    """Sums of lanes 0, 3, 6, 9, 12, of 1, 4, ... and of 2, 5, ... in lanes 0 to 2."""
    # Lanes j, j + 3, j + 6, j + 9 by two additions, then j + 12; lane 15 is padding.
    pairs = add(v, later_6(v))
    return add(add(pairs, later_3(pairs)), later_12(v))


@always_inline
def _shade(base, others):
    """max(0, 1/2 + y_0 h_0 + others); NaN stays NaN, as blending leaves such Gaussians out."""
    shade = (Y0 * base + others) + np.float32(0.5)
    return np.float32(0.0) if shade < np.float32(0.0) else shade  # noqa: FURB136  (NaN)


@always_inline
def _unless_clamped(d_color, color):
    """The gradient of a colour, 0 where the colour is clamped at 0."""
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
    """Derivatives of the forms along an axis, through its square and its two products."""
    # d form / dx = 2 c1 x + c4 y + c6 z, and likewise for the other axes
    products = fma(load(table, with_one), one, multiply(load(table, with_other), other))
    return fma(load(table, square), twice, products)


@always_inline
def _weighted(gradients, a, b, c):
    """Derivatives of the y_k times the numbers of a row, to be summed over lanes."""
    total = fma(spread_1(gradients), b, multiply(spread_0(gradients), a))
    return fma(spread_2(gradients), c, total)
