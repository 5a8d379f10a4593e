"""Surfaces that are fitted to the neighbours of every base point: ``mls`` and ``spline``.

*Moving least squares* (paper, eqs. 4-5): a weighted quadratic height field. Minimise sum_j w_j
(q(u_j, v_j) - z_j)^2 over q of degree 2, with w_j = 1 / max(d_j, d_1 / 2): inverse to the distance
from the base point, bounded at the base itself. Coordinates are scaled by the distance of the k-th
neighbour, and a ridge of 1e-6 times the mean diagonal resolves what collinear or too few neighbours
leave undetermined. In world axes, as the paper has it, the ridge is 1e-12, so that it decides
nothing else. A position drawn on the patch is moved along the normal onto q.

*B-spline surfaces* (paper, eq. 3): a smooth tensor-product cubic. Default: a P-spline. Over the 6 x
6 control values c of ``_kernels.splines``, minimise sum_j (S(u_j, v_j) - z_j)^2 + lambda c' P c;
the penalty makes the problem well-posed for 26 points and 36 unknowns. P is a discrete thin plate,
D2'D2 x I + 2 D1'D1 x D1'D1 + I x D2'D2 (after P. Eilers and B. Marx, Flexible smoothing with
B-splines and penalties, 1996, with the cross term of a thin plate). It is 0 for planes, so strong
smoothing tends to the least-squares plane.

Paper: FITPACK with smoothing s = 0.1 k at k = 25. ``SmoothBivariateSpline`` has no room for an
inner knot there, so s never acts, and the spline is the tensor-product cubic polynomial of 16 terms
in world axes. ``basis="bicubic"`` fits it by LAPACK's minimum-norm least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from jaxtyping import Float32, Float64, Int8

from splatseed.methods._kernels import splines as kernels
from splatseed.methods._kernels.mls import mls_heights
from splatseed.methods._kernels.splines import COEFFICIENTS, CONTROL
from splatseed.methods.patches import FitSize, Patches, PatchMethod
from splatseed.settings import Range

RIDGE = {"local": 1e-6, "world": 1e-12}
"""Ridge by frame, relative to the mean diagonal. In world axes neighbours are often nearly
collinear: a ridge of 1e-6 would move 1.4% of fern's new points by over a tenth of the spacing."""


@dataclass(frozen=True)
class Mls(PatchMethod):
    """Points on weighted quadratic fits to the neighbours (moving least squares, eqs. 4-5)."""

    k: FitSize = 16
    """Neighbours in a fit (paper: 10)."""

    name: ClassVar[str] = "mls"

    @classmethod
    def paper(cls) -> Self:
        """Return k = 10, z = f(x, y) in world axes, positions in the bounding box."""
        return cls(k=10, frame="world", placement="box", clamp=None, reject_isolated=False)

    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write q(u, v) of all their new points into ``out`` [M]."""
        mls_heights(
            patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance, patches.frames,
            patches.bases.start, patches.bases.count, patches.uv, RIDGE[self.frame], first, last,
            out,
        )  # fmt: skip


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
        """Return k = 25, z = S(x, y) in world axes, positions in the bounding box."""
        return cls(
            basis="bicubic", frame="world", placement="box", clamp=None, reject_isolated=False
        )

    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write S(u, v) of all their new points into ``out`` [M]."""
        bases = patches.bases
        if self.basis == "bicubic":
            kernels.bicubic_heights(
                patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance,
                patches.frames, bases.start, bases.count, patches.uv, first, last, out,
            )  # fmt: skip
            return
        basis = _patch_basis(patches, first, last)
        coefficients = np.zeros((last - first, COEFFICIENTS))
        kernels.fit(
            basis.weight, basis.cell, basis.z, bases.count[first:last], float(self.smoothing),
            penalty(), coefficients,
        )  # fmt: skip
        kernels.evaluate(
            bases.start, bases.count, patches.uv, coefficients, basis.scale, first, last, out
        )


def penalty() -> Float64[np.ndarray, "36 36"]:
    """Return P, with which the roughness of control values c is c' P c."""
    identity = np.eye(CONTROL)
    first, second = np.diff(identity, axis=0), np.diff(identity, n=2, axis=0)
    slopes, bends = first.T @ first, second.T @ second
    return np.asarray(
        np.kron(bends, identity) + 2.0 * np.kron(slopes, slopes) + np.kron(identity, bends)
    )


class _PatchBasis(NamedTuple):
    """The basis at the m = k + 1 data points of some rows; the base point is the last of a row."""

    weight: Float64[np.ndarray, "rows m 2 4"]  # the four non-zero B-splines along u and along v
    cell: Int8[np.ndarray, "rows m 2"]  # index of the first of them
    z: Float64[np.ndarray, "rows m"]  # scaled heights
    scale: Float64[np.ndarray, "rows 3"]  # scene units per unit of u, v and z


def _patch_basis(patches: Patches, first: int, last: int) -> _PatchBasis:
    """Evaluate the basis for rows ``first:last``; rows without new points stay empty."""
    rows, m = last - first, patches.neighbors.k + 1
    cell, z = np.zeros((rows, m, 2), np.int8), np.zeros((rows, m))
    basis = _PatchBasis(np.zeros((rows, m, 2, 4)), cell, z, np.ones((rows, 3)))
    kernels.fill_basis(
        patches.cloud.xyz, patches.neighbors.idx, patches.neighbors.distance, patches.frames,
        patches.bases.count, first, last, *basis,
    )  # fmt: skip
    return basis
