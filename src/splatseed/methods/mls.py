"""Moving least squares (paper, eqs. 4-5): a weighted quadratic height field at every base point.

Minimise sum_j w_j (q(u_j, v_j) - z_j)^2 over q of degree 2, with w_j = 1 / max(d_j, d_1 / 2):
inverse to the distance from the base point, bounded at the base itself. Coordinates are scaled
by the distance of the k-th neighbour, and a ridge of 1e-6 times the mean diagonal resolves what
collinear or too few neighbours leave undetermined. In world axes, as the paper has it, the ridge is
1e-12, so that it decides nothing else. A position drawn on the patch is moved along the normal onto
q.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Float32

from splatseed.methods._kernels.mls import mls_heights
from splatseed.methods.patches import FitSize, Patches, PatchMethod

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
