"""P-splines on patches, and the bicubic that FITPACK makes of the paper's parameters (eq. 3).

C = 6 control values a side on the domain [-1, 1] (3 uniform intervals); coefficients c[a, b] lie
flat as c[6 a + b]; S(u, v) = sum_ab B_a(u) B_b(v) c[a, b]. On a patch, u and v are scaled by the
neighbours' largest |u| and |v|, z by 1.5 times the distance of the k-th neighbour.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import inline, kernel, parallel_range

CONTROL = 6
"""Control values a side: 3 uniform intervals and cubic degree."""
COEFFICIENTS = CONTROL * CONTROL
BAND = 3 * CONTROL + 3
"""Bandwidth: two overlapping basis functions are at most this far apart in the flat order."""
RIDGE = 1e-9
"""For control values that no data and, for a plane, no penalty determines."""
HEIGHT_UNIT = 1.5
"""Unit of heights, in distances of the k-th neighbour."""
MIN_WIDTH = 1e-6
"""Smallest half-width of the domain, in distances of the k-th neighbour: a collinear patch has none
along v."""
MIN_SINGULAR = 1e-10
"""Singular values below this part of the largest count as 0. On a lattice of points they are
rounding errors, and their inverses would put new points at any distance."""
DEGREE = 3
BICUBIC_TERMS = (DEGREE + 1) * (DEGREE + 1)


@kernel
def fill_basis(xyz, idx, distance, frames, count, first, last, weight, cell, z, scale):
    """Fill the B-splines' values and cells, scaled heights and scales of rows ``first:last``."""
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
def _local_points(xyz, i, rows, frame, reach, scale):
    """Scaled (u, v, z) of the neighbours and, last, the base [k + 1, 3]; fills the scales."""
    k = rows.size
    points = np.zeros((k + 1, 3))
    scale[0], scale[1], scale[2] = MIN_WIDTH * reach, MIN_WIDTH * reach, HEIGHT_UNIT * reach
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
def _weights(t):
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
def fit(weight, cell, z, count, smoothing, roughness, coefficients):
    """Solve (B'B + smoothing P + RIDGE I) c = B'z for every row with new points."""
    for row in parallel_range(len(z)):
        if count[row] > 0:
            normal = np.empty((COEFFICIENTS, COEFFICIENTS))
            for a in range(COEFFICIENTS):
                for b in range(a, min(COEFFICIENTS, a + BAND + 1)):
                    normal[a, b] = smoothing * roughness[a, b]
                normal[a, a] += RIDGE
            _accumulate(weight[row], cell[row], z[row], normal, coefficients[row])
            _solve(normal, coefficients[row])


@inline
def _accumulate(weight, cell, z, normal, rhs):
    """Add B'B (upper triangle) and B'z; every data point touches 4 x 4 control values."""
    product = np.empty((4, 4))
    for j in range(z.size):
        corner = CONTROL * cell[j, 0] + cell[j, 1]
        for a in range(4):
            for b in range(4):
                product[a, b] = weight[j, 0, a] * weight[j, 1, b]
        for a in range(4):
            for b in range(4):
                w, p = product[a, b], corner + CONTROL * a + b
                rhs[p] += w * z[j]
                for c in range(b, 4):
                    normal[p, p - b + c] += w * product[a, c]
                for d in range(a + 1, 4):
                    q = corner + CONTROL * d
                    for c in range(4):
                        normal[p, q + c] += w * product[d, c]


@inline
def _solve(normal, rhs):
    """Solve in place by a banded Cholesky factor U'U; whole rows are updated, to vectorise."""
    n = rhs.size
    for a in range(n):
        end = min(n, a + BAND + 1)
        pivot = 1.0 / math.sqrt(normal[a, a])
        rhs[a] *= pivot
        for b in range(a, end):
            normal[a, b] *= pivot
        for b in range(a + 1, end):
            factor = normal[a, b]
            rhs[b] -= factor * rhs[a]
            for c in range(b, end):
                normal[b, c] -= factor * normal[a, c]
    for a in range(n - 1, -1, -1):
        for c in range(a + 1, min(n, a + BAND + 1)):
            rhs[a] -= normal[a, c] * rhs[c]
        rhs[a] /= normal[a, a]


@kernel
def evaluate(start, count, uv, coefficients, scale, first, last, out):
    """Write S(u, v) in scene units; outside the domain, that of the nearest position in it."""
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


@kernel
def bicubic_heights(xyz, idx, distance, frames, start, count, uv, first, last, out):
    """Write the least-squares bicubic polynomial at all new points of rows ``first:last``."""
    for i in parallel_range(first, last):
        if count[i] > 0:
            reach = distance[i, -1]
            design, z = _design(xyz, i, idx[i], frames[i], reach)
            coefficients = np.linalg.lstsq(design, z, MIN_SINGULAR)[0]
            term = np.empty(BICUBIC_TERMS)
            for m in range(start[i], start[i] + count[i]):
                _terms(uv[m, 0] / reach, uv[m, 1] / reach, term)
                total = 0.0
                for a in range(BICUBIC_TERMS):
                    total += coefficients[a] * term[a]
                out[m] = reach * total


@inline
def _design(xyz, i, rows, frame, reach):
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
def _terms(u, v, out):
    """Products of Chebyshev polynomials T0..T3 of u and v, better conditioned than powers."""
    tu = (1.0, u, 2.0 * u * u - 1.0, u * (4.0 * u * u - 3.0))
    tv = (1.0, v, 2.0 * v * v - 1.0, v * (4.0 * v * v - 3.0))
    for a in range(DEGREE + 1):
        for b in range(DEGREE + 1):
            out[(DEGREE + 1) * a + b] = tu[a] * tv[b]
