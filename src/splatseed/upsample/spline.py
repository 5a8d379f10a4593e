"""B-spline surfaces (paper, eq. 3): a smooth tensor-product cubic at every base point.

Default: a P-spline. With the k neighbours and the base scaled to (u, v) in [-1, 1]^2 and z in units
of 1.5 times the k-th distance, minimise sum_j (S(u_j, v_j) - z_j)^2 + lambda c' P c over the 6 x 6
control values c; the penalty makes the problem well-posed for 26 points and 36 unknowns.
lambda is fixed, or chosen for every patch by generalised cross-validation (``spline_gcv``).

Paper: FITPACK with smoothing s = 0.1 k at k = 25. Its smoothing is inert there: no fit gets an inner
knot, so the result is the least-squares bicubic polynomial in world axes, which is what
``basis="bicubic"`` computes (``spline_bicubic``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.jit import inline, kernel, parallel_range
from splatseed.upsample.method import require
from splatseed.upsample.patch_method import PatchMethod
from splatseed.upsample.patches import Patches
from splatseed.upsample.spline_basis import CONTROL, penalty

__all__ = ["Spline"]

COEFFICIENTS = CONTROL * CONTROL
HEIGHT_UNIT = 1.5
RIDGE = 1e-9
"""Settles control values that no point and, on a plane, no penalty holds."""


@dataclass(frozen=True)
class Spline(PatchMethod):
    """Points on smooth B-spline surfaces fitted to the neighbours (eq. 3).

    Example:
        >>> import numpy as np, splatseed as ss
        >>> u, v = np.random.default_rng(0).uniform(-1, 1, (2, 500))
        >>> xyz = np.stack([u, v, np.sin(2 * u)], axis=1).astype(np.float32)
        >>> rgb = np.full((500, 3), 128, np.uint8)
        >>> more, _ = ss.upsample_points(xyz, rgb, method="spline", ratio=8)
        >>> bool(np.abs(more[:, 2] - np.sin(2 * more[:, 0])).mean() < 0.005)
        True
    """

    k: int = 25
    """Neighbours in a fit (paper: 25)."""
    basis: Literal["pspline", "bicubic"] = "pspline"
    """A penalised 6 x 6 cubic B-spline, or what FITPACK makes of the paper's parameters: a bicubic
    polynomial (paper: bicubic)."""
    smoothing: float | Literal["gcv"] = 0.01
    """Weight of the roughness penalty, without unit, or "gcv" to choose it for every patch by
    generalised cross-validation (P-spline only)."""
    s: float = 2.5
    """FITPACK's smoothing bound 0.1 k, kept for the record: it is inert (bicubic only)."""

    name: ClassVar[str] = "spline"

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.smoothing == "gcv" or (not isinstance(self.smoothing, str) and self.smoothing > 0),
            'spline.smoothing above 0, or "gcv"',
            self.smoothing,
        )

    @classmethod
    def paper(cls) -> Self:
        """k = 25, s = 0.1 k, z = S(x, y) in world axes, positions in the bounding box."""
        return cls(
            basis="bicubic", frame="world", placement="box", clamp=None, reject_isolated=False
        )

    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write S(u, v) of all their outputs into ``out`` [M]."""
        if self.basis == "bicubic":
            from splatseed.upsample.spline_bicubic import bicubic_heights  # noqa: PLC0415

            bicubic_heights(patches, first, last, out)
            return
        smoothing = self._smoothing(patches, first, last)
        _heights(
            patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance, patches.frames,
            patches.bases.start, patches.bases.count, patches.uv, first, last,
            smoothing, penalty(), out,
        )  # fmt: skip

    def _smoothing(self, patches: Patches, first: int, last: int) -> Float64[np.ndarray, " rows"]:
        """lambda of each of the rows ``first:last``."""
        if isinstance(self.smoothing, str):
            from splatseed.upsample.spline_gcv import cross_validate  # noqa: PLC0415

            return cross_validate(patches, first, last)
        return np.full(last - first, float(self.smoothing))


@kernel
def _heights(  # type: ignore[no-untyped-def]
    xyz, idx, distance, frames, start, count, uv, first, last, smoothing, penalty_matrix, out
):
    """Heights of all outputs of rows ``first:last``."""
    for i in parallel_range(first, last):
        if count[i] > 0:
            points, su, sv, sz = _local_points(xyz, i, idx[i], frames[i], distance[i, -1])
            c = _fit(points, smoothing[i - first], penalty_matrix)
            for m in range(start[i], start[i] + count[i]):
                u, v = np.float64(uv[m, 0]) / su, np.float64(uv[m, 1]) / sv
                out[m] = sz * _evaluate(c, min(max(u, -1.0), 1.0), min(max(v, -1.0), 1.0))


@inline
def _local_points(xyz, i, rows, frame, reach):  # type: ignore[no-untyped-def]
    """(u, v, z) of the neighbours and the base [k + 1, 3], scaled, and the three scales."""
    k = rows.size
    points = np.zeros((k + 1, 3))
    su = sv = 1e-6 * reach  # a line has no extent along v
    for j in range(k):
        for axis in range(3):
            step = xyz[rows[j], axis] - xyz[i, axis]
            for out_axis in range(3):
                points[j, out_axis] += step * frame[out_axis, axis]
        su, sv = max(su, abs(points[j, 0])), max(sv, abs(points[j, 1]))
    sz = HEIGHT_UNIT * reach
    for j in range(k):
        points[j, 0] /= su
        points[j, 1] /= sv
        points[j, 2] /= sz
    return points, su, sv, sz


@inline
def _fit(points, smoothing, penalty_matrix):  # type: ignore[no-untyped-def]
    """The 36 control values, by Cholesky on the upper triangle of B'B + lambda P."""
    normal = np.empty((COEFFICIENTS, COEFFICIENTS))
    for a in range(COEFFICIENTS):
        for b in range(a, COEFFICIENTS):
            normal[a, b] = smoothing * penalty_matrix[a, b]
        normal[a, a] += RIDGE
    rhs = np.zeros(COEFFICIENTS)
    _accumulate(points, normal, rhs)
    _solve(normal, rhs)
    return rhs


@inline
def _accumulate(points, normal, rhs):  # type: ignore[no-untyped-def]
    """Add B'B and B'z of the points; every point touches 4 x 4 control values."""
    row, where = np.empty(16), np.empty(16, np.int64)
    for j in range(len(points)):
        ua, u0, u1, u2, u3 = _weights(points[j, 0])
        va, v0, v1, v2, v3 = _weights(points[j, 1])
        for a, wu in enumerate((u0, u1, u2, u3)):
            for b, wv in enumerate((v0, v1, v2, v3)):
                row[4 * a + b] = wu * wv
                where[4 * a + b] = CONTROL * (ua + a) + va + b
        for p in range(16):
            weight = row[p]
            rhs[where[p]] += weight * points[j, 2]
            for q in range(p, 16):
                normal[where[p], where[q]] += weight * row[q]


@inline
def _weights(t):  # type: ignore[no-untyped-def]
    """First control index and the four uniform cubic B-spline weights at t in [-1, 1]."""
    x = (t + 1.0) * 1.5
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


@inline
def _solve(normal, rhs):  # type: ignore[no-untyped-def]
    """Solve in place with the Cholesky factor U'U; rows are updated whole, so that they vectorise."""
    n = rhs.size
    for a in range(n):
        pivot = 1.0 / math.sqrt(normal[a, a])
        for b in range(a, n):
            normal[a, b] *= pivot
        rhs[a] *= pivot
        top = normal[a]
        for b in range(a + 1, n):
            factor = top[b]
            if factor != 0.0:
                rhs[b] -= factor * rhs[a]
                target = normal[b]
                for c in range(b, n):
                    target[c] -= factor * top[c]
    for a in range(n - 1, -1, -1):
        total = rhs[a]
        for c in range(a + 1, n):
            total -= normal[a, c] * rhs[c]
        rhs[a] = total / normal[a, a]


@inline
def _evaluate(c, u, v):  # type: ignore[no-untyped-def]
    ua, u0, u1, u2, u3 = _weights(u)
    va, v0, v1, v2, v3 = _weights(v)
    total = 0.0
    for a, wu in enumerate((u0, u1, u2, u3)):
        row = CONTROL * (ua + a) + va
        total += wu * (v0 * c[row] + v1 * c[row + 1] + v2 * c[row + 2] + v3 * c[row + 3])
    return total
