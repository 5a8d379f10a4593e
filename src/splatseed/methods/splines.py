"""Splines on patches: the tensor-product cubic B-spline, its smoothing, and the paper's bicubic.

Notation: C = 6 control values a side on the domain [-1, 1] (3 uniform intervals); coefficients
c[a, b] lie flat as c[6 a + b]; S(u, v) = sum_ab B_a(u) B_b(v) c[a, b]. On a patch, u and v are
scaled by the neighbours' largest |u| and |v|, and z by 1.5 times the k-th distance, so that every
patch poses the same problem whatever the scene's units.
Penalty: a discrete thin plate, D2'D2 x I + 2 D1'D1 x D1'D1 + I x D2'D2 (after P. Eilers and B.
Marx, Flexible smoothing with B-splines and penalties, 1996, with the cross term of a thin plate).
Its null space is the planes, so that strong smoothing tends to the least-squares plane.
Paper: with k = 25 points and cubic degrees, FITPACK's ``SmoothBivariateSpline`` has room for no
inner knot, so that its smoothing s never acts: the spline is the tensor-product cubic polynomial of
16 terms. It is fitted here by LAPACK's minimum-norm least squares, patch by patch, in coordinates
scaled to [-1, 1].
"""

from __future__ import annotations

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
