"""Heights of weighted quadratic fits: moving least squares (paper, eqs. 4-5).

Minimise sum_j w_j (q(u_j, v_j) - z_j)^2 over q of degree 2, w_j = 1 / max(d_j, d_1 / 2).
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import inline, kernel, parallel_range

TERMS = 6
"""1, u, v, u^2, uv, v^2."""


@kernel
def mls_heights(xyz, idx, distance, frames, start, count, uv, ridge, first, last, out):
    """Heights of all new points of rows ``first:last``."""
    for i in parallel_range(first, last):
        if count[i] > 0:
            scale = distance[i, -1]
            q = _fit(xyz, i, idx[i], distance[i], frames[i], ridge)
            for m in range(start[i], start[i] + count[i]):
                u, v = uv[m, 0] / scale, uv[m, 1] / scale
                # q(u, v), by Horner's rule
                value = q[0] + u * (q[1] + u * q[3] + v * q[4]) + v * (q[2] + v * q[5])
                out[m] = scale * value


@inline
def _fit(xyz, i, rows, distance, frame, ridge):
    """Coefficients of 1, u, v, u^2, uv, v^2, with lengths in units of the k-th distance."""
    normal, rhs = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
    term = np.empty(TERMS)
    scale = 1.0 / distance[-1]
    floor = 0.5 * distance[0]
    for j in range(-1, rows.size):  # -1 is the base itself, at the origin
        u = v = z = 0.0
        # w = 1 / max(d, d_1 / 2), times d_k to be without a unit; the base has d = 0.
        weight = distance[-1] / floor
        if j >= 0:
            weight = distance[-1] / max(distance[j], floor)
            for axis in range(3):
                step = (xyz[rows[j], axis] - xyz[i, axis]) * scale
                u += step * frame[0, axis]
                v += step * frame[1, axis]
                z += step * frame[2, axis]
        term[0], term[1], term[2], term[3], term[4], term[5] = 1.0, u, v, u * u, u * v, v * v
        for a in range(TERMS):
            scaled = weight * term[a]
            rhs[a] += scaled * z
            for b in range(a + 1):
                normal[a, b] += scaled * term[b]
    _solve(normal, rhs, ridge)
    return rhs


@inline
def _solve(normal, rhs, ridge):
    """Solve the ridge-regularised normal equations in place, by Cholesky on the lower triangle."""
    trace = 0.0
    for a in range(TERMS):
        trace += normal[a, a]
    for a in range(TERMS):
        normal[a, a] += ridge * trace / TERMS
    for a in range(TERMS):
        for b in range(a):
            for c in range(b):
                normal[a, b] -= normal[a, c] * normal[b, c]
            normal[a, b] /= normal[b, b]
        for c in range(a):
            normal[a, a] -= normal[a, c] * normal[a, c]
            rhs[a] -= normal[a, c] * rhs[c]
        # L L' = normal; the forward substitution L y = rhs runs along.
        normal[a, a] = math.sqrt(normal[a, a])
        rhs[a] /= normal[a, a]
    # L' x = y
    for a in range(TERMS - 1, -1, -1):
        for c in range(a + 1, TERMS):
            rhs[a] -= normal[c, a] * rhs[c]
        rhs[a] /= normal[a, a]
