"""Real spherical harmonics up to degree 3: the basis functions, and their tables for the kernels.

Basis, order and signs are those of 3D Gaussian Splatting and gsplat (P.-P. Sloan, Efficient
Spherical Harmonic Evaluation, 2013).

Notation: a basis function y_k of the unit direction (x, y, z) is a *factor* (1, x, y or z) times a
*form*, c0 + c1 xx + c2 yy + c3 zz + c4 xy + c5 yz + c6 xz. A *row* is the 45 coefficients of a
Gaussian beyond the first of each channel, 15 times red, green, blue; kernels read it as three
overlapping vectors of 16 that start at ``FIRST``.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.runtime.simd import LANES

MAX_DEGREE = 3
TERMS = 16
"""Basis functions of degree 3: 1 + 3 + 5 + 7; equal to the lanes of a vector."""
CHANNELS = 3
ROW = 45
"""Coefficients in a row: 15 functions beyond the first, 3 channels each."""
FIRST = (0, 15, 29)
"""Offsets of the three vectors in a row; the last one ends with the row."""
PART = 15
"""Numbers that each vector contributes; its overlap with another counts once."""
# Y0 = sqrt(1 / (4 pi)), Y1 = sqrt(3 / (4 pi)), Y2A = sqrt(15 / (4 pi)), Y2B = 3 Y2D,
# Y2D = sqrt(5 / (16 pi)), Y2C = Y2A / 2; degree 3 likewise.
Y0 = 0.2820947917738781
Y1 = 0.48860251190292
Y2A, Y2B, Y2C = 1.0925484305920792, 0.9461746957575601, 0.5462742152960396
Y2D = 0.3153915652525201
Y3A, Y3B, Y3C = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
Y3D, Y3E = 0.3731763325901154, 1.445305721320277
FUNCTIONS: tuple[tuple[str, dict[str, float]], ...] = (
    # y_0, degree 0
    ("1", {"1": Y0}),
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
"""Factor and form of each basis function."""
FACTORS, FORMS = ("1", "x", "y", "z"), ("1", "xx", "yy", "zz", "xy", "yz", "xz")
FORM, USED = LANES * len(FACTORS), LANES * (len(FACTORS) + len(FORMS))
"""Offsets in a table. Its rows of 16 lanes, function k in lane k: the factors 1, x, y, z; from FORM
on the form's coefficients of 1, xx, yy, zz, xy, yz, xz; from USED on three rows with 1 in the used
lanes of a row's three vectors."""


def sh_basis(
    directions: Float64[np.ndarray, "N 3"], terms: int = TERMS
) -> Float64[np.ndarray, "N terms"]:
    """Evaluate the first basis functions at unit directions."""
    x, y, z = directions.T
    values = {
        "1": np.ones_like(x), "x": x, "y": y, "z": z,
        "xx": x * x, "yy": y * y, "zz": z * z, "xy": x * y, "yz": y * z, "xz": x * z,
    }  # fmt: skip
    basis = np.empty((len(directions), terms))
    for k, (factor, form) in enumerate(FUNCTIONS[:terms]):
        # y_k = factor_k form_k
        basis[:, k] = values[factor] * sum(c * values[name] for name, c in form.items())
    return basis


def coefficient_index(number: int) -> int:
    """Return k of the coefficient h_k that a number of a row belongs to."""
    return 1 + number // CHANNELS


def _table(degree: int) -> Float32[np.ndarray, " 224"]:
    terms = (degree + 1) ** 2
    table = np.zeros((len(FACTORS) + len(FORMS) + len(FIRST), LANES), np.float32)
    for k, (factor, form) in enumerate(FUNCTIONS[:terms]):
        table[FACTORS.index(factor), k] = 1.0
        for name, value in form.items():
            table[len(FACTORS) + FORMS.index(name), k] = value
    for part, first in enumerate(FIRST):
        for number in range(PART * part, PART * (part + 1)):
            table[part - len(FIRST), number - first] = coefficient_index(number) < terms
    return table.reshape(-1)


TABLES = tuple(map(_table, range(MAX_DEGREE + 1)))
"""The kernels' tables by degree, flat."""
