"""Splines on patches: the tensor-product cubic B-spline, its smoothing, and the paper's bicubic.

Notation: C = 6 control values a side on the domain [-1, 1] (3 uniform intervals); coefficients
c[a, b] lie flat as c[6 a + b]; S(u, v) = sum_ab B_a(u) B_b(v) c[a, b]. On a patch, u and v are
scaled by the neighbours' largest |u| and |v|, and z by 1.5 times the k-th distance, so that every
patch poses the same problem whatever the scene's units.
Penalty: a discrete thin plate, D2'D2 x I + 2 D1'D1 x D1'D1 + I x D2'D2 (after P. Eilers and B.
Marx, Flexible smoothing with B-splines and penalties, 1996, with the cross term of a thin plate).
Its null space is the planes, so that strong smoothing tends to the least-squares plane.
Generalised cross-validation: with K = B P^+ B' [m, m] and X = [1, u, v] [m, 3] (what the penalty
leaves free), the P-spline's residual operator is I - H = lambda Q (Q'KQ + lambda I)^-1 Q', Q
spanning the complement of X, and GCV(lambda) = m |(I - H) z|^2 / tr(I - H)^2 (P. Craven and G.
Wahba, 1979). Q'KQ is made tridiagonal once, after which every lambda costs O(m) (as C. Gu and G.
Wahba do for thin plates, 1991).
Paper: with k = 25 points and cubic degrees, FITPACK's ``SmoothBivariateSpline`` has room for no
inner knot, so that its smoothing s never acts: the spline is the tensor-product cubic polynomial of
16 terms. It is fitted here by LAPACK's minimum-norm least squares, patch by patch, in coordinates
scaled to [-1, 1].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int8

from splatseed.methods.patches import Patches
from splatseed.runtime.jit import inline, kernel, parallel_range

CONTROL = 6  # control values a side: 3 uniform intervals and cubic degree
COEFFICIENTS = CONTROL * CONTROL
HEIGHT_UNIT = 1.5  # unit of heights, in distances of the k-th neighbour
LINE = 1e-6  # least extent along v, as a fraction of the k-th distance: a collinear patch has none


def penalty() -> Float64[np.ndarray, "36 36"]:
    """The penalty matrix P, so that roughness = c' P c."""
    identity = np.eye(CONTROL)
    first, second = np.diff(identity, axis=0), np.diff(identity, n=2, axis=0)
    slopes, bends = first.T @ first, second.T @ second
    return np.asarray(
        np.kron(bends, identity) + 2.0 * np.kron(slopes, slopes) + np.kron(identity, bends)
    )


class PatchBasis(NamedTuple):
    """The basis at the m = k + 1 data points of some rows; the base point is the last of each."""

    weight: Float64[np.ndarray, "rows m 2 4"]  # the four non-zero B-splines along u and along v
    cell: Int8[np.ndarray, "rows m 2"]  # index of the first of them
    z: Float64[np.ndarray, "rows m"]  # scaled heights
    scale: Float64[np.ndarray, "rows 3"]  # scene units per unit of u, v and z


def patch_basis(patches: Patches, first: int, last: int) -> PatchBasis:
    """The basis at the data points of rows ``first:last``; rows without new points stay empty."""
    rows, m = last - first, patches.neighbors.k + 1
    cell, z = np.zeros((rows, m, 2), np.int8), np.zeros((rows, m))
    basis = PatchBasis(np.zeros((rows, m, 2, 4)), cell, z, np.ones((rows, 3)))
    _patch_basis(
        patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance, patches.frames,
        patches.bases.count, first, last, *basis,
    )  # fmt: skip
    return basis


def evaluate(
    patches: Patches,
    coefficients: Float64[np.ndarray, "rows 36"],
    scale: Float64[np.ndarray, "rows 3"],
    first: int,
    last: int,
    out: Float32[np.ndarray, " M"],
) -> None:
    """Write S(u, v), in scene units, of all new points of rows ``first:last`` into ``out``.

    Outside the domain it is that of the nearest position in it.
    """
    _evaluate(
        patches.bases.start, patches.bases.count, patches.uv, coefficients, scale, first, last, out
    )


@kernel
def _patch_basis(xyz, idx, distance, frames, count, first, last, weight, cell, z, scale):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(first, last):
        if count[i] > 0:
            row = i - first
            points = _local_points(xyz, i, idx[i], frames[i], distance[i, -1], scale[row])
            for j in range(len(points)):
                for axis in range(2):
                    where, w0, w1, w2, w3 = _weights(points[j, axis])
                    cell[row, j, axis] = where
                    weight[row, j, axis, 0], weight[row, j, axis, 1] = w0, w1
                    weight[row, j, axis, 2], weight[row, j, axis, 3] = w2, w3
                z[row, j] = points[j, 2]


@inline
def _local_points(xyz, i, rows, frame, reach, scale):  # type: ignore[no-untyped-def]  # Numba's types
    """Scaled (u, v, z) of the neighbours and, last, the base [k + 1, 3]; fills the scales."""
    k = rows.size
    points = np.zeros((k + 1, 3))
    scale[0], scale[1], scale[2] = LINE * reach, LINE * reach, HEIGHT_UNIT * reach
    for j in range(k):
        for axis in range(3):
            step = xyz[rows[j], axis] - xyz[i, axis]
            for out_axis in range(3):
                points[j, out_axis] += step * frame[out_axis, axis]
        scale[0], scale[1] = max(scale[0], abs(points[j, 0])), max(scale[1], abs(points[j, 1]))
    for j in range(k):
        for axis in range(3):
            points[j, axis] /= scale[axis]
    return points


@inline
def _weights(t):  # type: ignore[no-untyped-def]  # Numba's types
    """First control index and the four uniform cubic B-splines at t in [-1, 1]."""
    x = (t + 1.0) * 0.5 * (CONTROL - 3)
    cell = min(max(int(x), 0), CONTROL - 4)
    f = x - cell
    g = 1.0 - f
    return (
        cell,
        g * g * g / 6.0,
        (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0,
        (3.0 * g * g * g - 6.0 * g * g + 4.0) / 6.0,
        f * f * f / 6.0,
    )


@kernel
def _evaluate(start, count, uv, coefficients, scale, first, last, out):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(first, last):
        c, unit = coefficients[i - first], scale[i - first]
        for m in range(start[i], start[i] + count[i]):
            u = min(max(np.float64(uv[m, 0]) / unit[0], -1.0), 1.0)
            v = min(max(np.float64(uv[m, 1]) / unit[1], -1.0), 1.0)
            ua, u0, u1, u2, u3 = _weights(u)
            va, v0, v1, v2, v3 = _weights(v)
            total = 0.0
            for a, wu in enumerate((u0, u1, u2, u3)):
                p = CONTROL * (ua + a) + va
                total += wu * (v0 * c[p] + v1 * c[p + 1] + v2 * c[p + 2] + v3 * c[p + 3])
            out[m] = unit[2] * total


LAMBDAS = np.logspace(-3.0, 2.0, 11)  # the candidates: from near interpolation to near a plane
FREE = 3  # dimension of the planes


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
        # a column that is 0 already, as of a collinear patch, needs no reflection.
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


NO_RANK = 1e-10
"""Singular values below this part of the largest count as 0, as those of a lattice's points are but
for rounding: their inverses would put points at any distance."""
DEGREE = 3
BICUBIC_TERMS = (DEGREE + 1) * (DEGREE + 1)


def bicubic_heights(
    patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
) -> None:
    """Write the polynomial's height at all new points of rows ``first:last`` into ``out`` [M]."""
    _bicubic_heights(
        patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance, patches.frames,
        patches.bases.start, patches.bases.count, patches.uv, first, last, out,
    )  # fmt: skip


@kernel
def _bicubic_heights(xyz, idx, distance, frames, start, count, uv, first, last, out):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(first, last):
        if count[i] > 0:
            reach = distance[i, -1]
            design, z = _design(xyz, i, idx[i], frames[i], reach)
            coefficients = np.linalg.lstsq(design, z, NO_RANK)[0]
            term = np.empty(BICUBIC_TERMS)
            for m in range(start[i], start[i] + count[i]):
                _terms(uv[m, 0] / reach, uv[m, 1] / reach, term)
                total = 0.0
                for a in range(BICUBIC_TERMS):
                    total += coefficients[a] * term[a]
                out[m] = reach * total


@inline
def _design(xyz, i, rows, frame, reach):  # type: ignore[no-untyped-def]  # Numba's types
    """Design matrix [k + 1, 16] and heights [k + 1] of the neighbours and the base."""
    design, z = np.empty((rows.size + 1, BICUBIC_TERMS)), np.zeros(rows.size + 1)
    for j in range(rows.size + 1):
        u = v = 0.0
        if j < rows.size:
            for axis in range(3):
                step = (xyz[rows[j], axis] - xyz[i, axis]) / reach
                u += step * frame[0, axis]
                v += step * frame[1, axis]
                z[j] += step * frame[2, axis]
        _terms(u, v, design[j])
    return design, z


@inline
def _terms(u, v, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Products of Chebyshev polynomials T0..T3 of u and v, better conditioned than powers."""
    tu = (1.0, u, 2.0 * u * u - 1.0, u * (4.0 * u * u - 3.0))
    tv = (1.0, v, 2.0 * v * v - 1.0, v * (4.0 * v * v - 3.0))
    for a in range(DEGREE + 1):
        for b in range(DEGREE + 1):
            out[(DEGREE + 1) * a + b] = tu[a] * tv[b]
