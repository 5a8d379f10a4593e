"""Generalised cross-validation: the smoothing of every patch, from its own data.

With K = B P^+ B' [m, m] and X = [1, u, v] [m, 3] (what the penalty leaves free), the P-spline's
residual operator is I - H = lambda Q (Q'KQ + lambda I)^-1 Q', Q spanning the complement of X, and
GCV(lambda) = m |(I - H) z|^2 / tr(I - H)^2 (P. Craven and G. Wahba, 1979). Q'KQ is made tridiagonal
once, after which every lambda costs O(m) (as C. Gu and G. Wahba do for thin plates, 1991).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.upsample.surfaces.spline_basis import CONTROL, PatchBasis, penalty

LAMBDAS = np.logspace(-3.0, 2.0, 11)
"""The candidates: from near interpolation to near a plane."""
COEFFICIENTS = CONTROL * CONTROL
FREE = 3
"""Dimension of the planes."""


def cross_validate(basis: PatchBasis, count: np.ndarray) -> Float64[np.ndarray, " rows"]:
    """The candidate of least GCV score for each row with ``count`` > 0 (for others, the first)."""
    chosen = np.full(len(basis.z), LAMBDAS[0])
    inverse = np.ascontiguousarray(np.linalg.pinv(penalty(), hermitian=True))
    _choose(basis.weight, basis.cell, basis.z, count, inverse, LAMBDAS, chosen)
    return chosen


@kernel
def _choose(weight, cell, z, count, inverse, candidates, chosen):  # type: ignore[no-untyped-def]  # Numba's types
    for row in parallel_range(len(z)):
        if count[row] > 0:
            gram = _gram(weight[row], cell[row], inverse)
            y = z[row].copy()
            _remove_planes(_planes(weight[row], cell[row]), gram, y)
            inner, residual = gram[FREE:, FREE:].copy(), y[FREE:].copy()
            diagonal, beside = _tridiagonalise(inner, residual)
            best = np.inf
            for candidate in candidates:
                score = _score(diagonal, beside, residual, candidate)
                if score < best:
                    best, chosen[row] = score, candidate


@inline
def _gram(weight, cell, inverse):  # type: ignore[no-untyped-def]  # Numba's types
    """K = B P^+ B' for one patch, [m, m]."""
    m = len(weight)
    half, gram = np.zeros(COEFFICIENTS), np.empty((m, m))
    for p in range(m):
        half[:] = 0.0
        for a in range(4):
            for b in range(4):
                w = weight[p, 0, a] * weight[p, 1, b]
                source = inverse[CONTROL * (cell[p, 0] + a) + cell[p, 1] + b]
                for c in range(COEFFICIENTS):
                    half[c] += w * source[c]
        for q in range(p + 1):
            total = 0.0
            for a in range(4):
                at = CONTROL * (cell[q, 0] + a) + cell[q, 1]
                along = 0.0
                for b in range(4):
                    along += weight[q, 1, b] * half[at + b]
                total += weight[q, 0, a] * along
            gram[p, q] = gram[q, p] = total
    return gram


@inline
def _planes(weight, cell):  # type: ignore[no-untyped-def]  # Numba's types
    """X = [1, u, v] at the data points (u and v up to scale and shift), [m, 3]."""
    planes = np.ones((len(weight), FREE))
    for j in range(len(weight)):
        for axis in range(2):
            w = weight[j, axis]
            # B-splines reproduce lines: sum_a B_a(u) a is linear in u.
            planes[j, 1 + axis] = cell[j, axis] - 1.5 + w[1] + 2.0 * w[2] + 3.0 * w[3]
    return planes


@inline
def _remove_planes(planes, gram, y):  # type: ignore[no-untyped-def]  # Numba's types
    """Rotate by the Householder QR of X, so that rows and columns 3.. are orthogonal to it."""
    m = len(y)
    v = np.empty(m)
    for column in range(FREE):
        squared = 0.0
        for j in range(column, m):
            v[j] = planes[j, column]
            squared += v[j] * v[j]
        alpha = -math.copysign(math.sqrt(squared), v[column])
        v[column] -= alpha
        squared += alpha * alpha - 2.0 * alpha * (v[column] + alpha)
        # A column that is 0 already, as of a collinear patch, needs no reflection.
        if squared > 1e-24 * m:
            _reflect_rows(planes, v, column, squared)
            _reflect_rows(gram, v, column, squared)
            _reflect_columns(gram, v, column, squared)
            _reflect_vector(y, v, column, squared)


@inline
def _reflect_rows(matrix, v, first, squared):  # type: ignore[no-untyped-def]  # Numba's types
    """Set matrix <- (I - 2 v v' / v'v) matrix, v being 0 before ``first``."""
    total = np.zeros(matrix.shape[1])
    for j in range(first, len(matrix)):
        for c in range(total.size):
            total[c] += v[j] * matrix[j, c]
    for j in range(first, len(matrix)):
        factor = 2.0 * v[j] / squared
        for c in range(total.size):
            matrix[j, c] -= factor * total[c]


@inline
def _reflect_columns(matrix, v, first, squared):  # type: ignore[no-untyped-def]  # Numba's types
    """Set matrix <- matrix (I - 2 v v' / v'v), v being 0 before ``first``."""
    for j in range(len(matrix)):
        _reflect_vector(matrix[j], v, first, squared)


@inline
def _reflect_vector(y, v, first, squared):  # type: ignore[no-untyped-def]  # Numba's types
    total = 0.0
    for j in range(first, y.size):
        total += v[j] * y[j]
    factor = 2.0 * total / squared
    for j in range(first, y.size):
        y[j] -= factor * v[j]


@inline
def _tridiagonalise(matrix, y):  # type: ignore[no-untyped-def]  # Numba's types
    """Diagonal [n] and off-diagonal [n - 1] of an orthogonally similar matrix; y turns along."""
    n = y.size
    diagonal, beside = np.empty(n), np.zeros(max(n - 1, 0))
    v, p = np.zeros(n), np.empty(n)
    for j in range(n - 2):
        squared = 0.0
        for c in range(j + 1, n):
            v[c] = matrix[j, c]
            squared += v[c] * v[c]
        alpha = -math.copysign(math.sqrt(squared), v[j + 1])
        beside[j] = alpha
        squared += alpha * alpha - 2.0 * alpha * v[j + 1]
        v[j + 1] -= alpha
        if squared > 0.0:
            _similar(matrix, v, p, j + 1, squared)
            _reflect_vector(y, v, j + 1, squared)
    for j in range(n):
        diagonal[j] = matrix[j, j]
    if n > 1:
        beside[n - 2] = matrix[n - 2, n - 1]
    return diagonal, beside


@inline
def _similar(matrix, v, p, first, squared):  # type: ignore[no-untyped-def]  # Numba's types
    """The symmetric rank-2 update of a Householder similarity on rows and columns ``first``.."""
    n = v.size
    p[first:] = 0.0
    for r in range(first, n):
        for c in range(first, n):
            p[c] += v[r] * matrix[r, c]
    dot = 0.0
    for c in range(first, n):
        p[c] *= 2.0 / squared
        dot += v[c] * p[c]
    for c in range(first, n):
        p[c] -= dot / squared * v[c]
    for r in range(first, n):
        for c in range(first, n):
            matrix[r, c] -= v[r] * p[c] + p[r] * v[c]


@inline
def _score(diagonal, beside, y, smoothing):  # type: ignore[no-untyped-def]  # Numba's types
    """|lambda (T + lambda)^-1 y|^2 / (lambda tr (T + lambda)^-1)^2: GCV without its constant m.

    The forward pivots f and backward pivots b of a tridiagonal matrix give both its solution and
    the diagonal of its inverse, 1 / (f_i + b_i - d_i).
    """
    n = y.size
    forward, carried = np.empty(n), np.empty(n)
    for i in range(n):
        forward[i], carried[i] = diagonal[i] + smoothing, y[i]
        if i > 0:
            # Elimination from the top, on matrix and right side alike.
            ratio = beside[i - 1] / forward[i - 1]
            forward[i] -= ratio * beside[i - 1]
            carried[i] -= ratio * carried[i - 1]
    trace = squared = solution = 0.0
    backward = 1.0
    for i in range(n - 1, -1, -1):
        pivot = diagonal[i] + smoothing
        backward_here, rest = pivot, carried[i]
        if i < n - 1:
            backward_here -= beside[i] * beside[i] / backward
            rest -= beside[i] * solution
        solution = rest / forward[i]
        # The i-th diagonal entry of the inverse.
        trace += 1.0 / (forward[i] + backward_here - pivot)
        squared += solution * solution
        backward = backward_here
    return squared / (trace * trace)
