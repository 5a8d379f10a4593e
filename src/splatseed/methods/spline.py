"""B-spline surfaces (paper, eq. 3): a smooth tensor-product cubic at every base point.

Default: a P-spline. Over the 6 x 6 control values c of ``splines``, minimise
sum_j (S(u_j, v_j) - z_j)^2 + lambda c' P c; the penalty makes the problem well-posed for 26 points
and 36 unknowns. lambda is fixed for all patches.

Paper: FITPACK with smoothing s = 0.1 k at k = 25. Its smoothing is inert there: no fit gets an
inner knot, so the result is the least-squares bicubic polynomial in world axes, which is what
``basis="bicubic"`` computes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.methods import splines
from splatseed.methods.patches import FitSize, Patches, PatchMethod
from splatseed.methods.splines import COEFFICIENTS, CONTROL, PatchBasis
from splatseed.runtime.jit import inline, kernel, parallel_range
from splatseed.settings import Range

BAND = 3 * CONTROL + 3
"""Bandwidth: two overlapping basis functions are at most this far apart in the flat order."""
RIDGE = 1e-9  # ridge for control values that no data and, for a plane, no penalty determines


@dataclass(frozen=True)
class Spline(PatchMethod):
    """Points on smooth B-spline surfaces fitted to the neighbours (eq. 3)."""

    k: FitSize = 25
    """Neighbours in a fit (paper: 25)."""
    basis: Literal["pspline", "bicubic"] = "pspline"
    """A penalised B-spline, or the bicubic that the paper's parameters give (paper: bicubic)."""
    smoothing: Annotated[float, Range(above=0)] = 0.01
    """Weight of the roughness penalty (paper: s = 0.1 k, inert)."""

    name: ClassVar[str] = "spline"

    @classmethod
    def paper(cls) -> Self:
        """With k = 25, z = S(x, y) in world axes, positions in the neighbourhood's bounding box."""
        return cls(
            basis="bicubic", frame="world", placement="box", clamp=None, reject_isolated=False
        )

    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write S(u, v) of all their new points into ``out`` [M]."""
        if self.basis == "bicubic":
            splines.bicubic_heights(patches, first, last, out)
            return
        basis = splines.patch_basis(patches, first, last)
        count = patches.bases.count[first:last]
        coefficients = fit(basis, count, self.smoothing)
        splines.evaluate(patches, coefficients, basis.scale, first, last, out)


def fit(basis: PatchBasis, count: np.ndarray, smoothing: float) -> Float64[np.ndarray, "rows 36"]:
    """Control values of every row with new points (``count`` > 0), [rows, 36]; else 0."""
    coefficients = np.zeros((len(basis.z), COEFFICIENTS))
    _fit(
        basis.weight, basis.cell, basis.z, count, float(smoothing), splines.penalty(), coefficients
    )
    return coefficients


@kernel
def _fit(weight, cell, z, count, smoothing, roughness, coefficients):  # type: ignore[no-untyped-def]  # Numba's types
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
def _accumulate(weight, cell, z, normal, rhs):  # type: ignore[no-untyped-def]  # Numba's types
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
def _solve(normal, rhs):  # type: ignore[no-untyped-def]  # Numba's types
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
