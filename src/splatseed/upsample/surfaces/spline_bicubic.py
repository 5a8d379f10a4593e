"""The paper's spline as FITPACK computes it: a least-squares bicubic polynomial.

With k = 25 points and cubic degrees, ``SmoothBivariateSpline`` has room for no inner knot, so that
its smoothing s never acts: the spline is the tensor-product cubic polynomial of 16 terms. It is
fitted here by LAPACK's minimum-norm least squares, patch by patch, in coordinates scaled to [-1,
1].
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.upsample.surfaces.patches import Patches

DEGREE = 3
TERMS = (DEGREE + 1) * (DEGREE + 1)


def bicubic_heights(
    patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
) -> None:
    """Write the polynomial's height at all new points of rows ``first:last`` into ``out`` [M]."""
    _heights(
        patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance, patches.frames,
        patches.bases.start, patches.bases.count, patches.uv, first, last, out,
    )  # fmt: skip


@kernel
def _heights(xyz, idx, distance, frames, start, count, uv, first, last, out):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(first, last):
        if count[i] > 0:
            reach = distance[i, -1]
            design, z = _design(xyz, i, idx[i], frames[i], reach)
            coefficients = np.linalg.lstsq(design, z)[0]
            term = np.empty(TERMS)
            for m in range(start[i], start[i] + count[i]):
                _terms(uv[m, 0] / reach, uv[m, 1] / reach, term)
                total = 0.0
                for a in range(TERMS):
                    total += coefficients[a] * term[a]
                out[m] = reach * total


@inline
def _design(xyz, i, rows, frame, reach):  # type: ignore[no-untyped-def]  # Numba's types
    """Design matrix [k + 1, 16] and heights [k + 1] of the neighbours and the base."""
    design, z = np.empty((rows.size + 1, TERMS)), np.zeros(rows.size + 1)
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
