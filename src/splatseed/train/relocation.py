"""What gsplat's MCMC strategy has in CUDA only, for the CPU: splitting a Gaussian, and covariances.

Notation: o opacity, s scales, n how many Gaussians share the place. With o' = 1 - (1 - o)^(1/n)
(3DGS as MCMC, Kheradmand et al. 2024, eq. 9; the double sum folded by the hockey-stick identity):

    s' = s o / sum_{k=0}^{n-1} (-1)^k C(n, k+1) o'^(k+1) / sqrt(k+1)

Promise: float64 inside, as the sum alternates; gsplat's files are not touched.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

__all__ = ["compute_relocation", "covariances", "mcmc_on_cpu"]


def compute_relocation(
    opacities: Float[Tensor, " N"],
    scales: Float[Tensor, "N 3"],
    ratios: Int[Tensor, " N"],
    binoms: Float[Tensor, "M M"],
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Opacities [N] and scales [N, 3] of each of ``ratios`` Gaussians that replace one.

    Args:
        opacities: From 0 to 1, [N].
        scales: Standard deviations, [N, 3].
        ratios: How many share the place, [N]; taken as at most M.
        binoms: gsplat's table of binomial coefficients; only its size is used.
    """
    largest = len(binoms)
    shares = ratios.clamp(1, largest)
    old = opacities.to(torch.float64)
    new = -torch.expm1(torch.log1p(-old) / shares)
    table = _coefficients(largest).to(old.device)
    total = torch.zeros_like(old)
    for k in reversed(range(largest)):  # Horner's rule
        total = (total + table[shares, k]) * new
    factor = torch.where(shares == 1, 1.0, old / total)
    return new.to(opacities.dtype), scales * factor.to(scales.dtype)[:, None]


def covariances(
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    compute_covar: bool = True,  # noqa: ARG001  (gsplat's signature)
    compute_preci: bool = False,  # noqa: ARG001
    triu: bool = False,  # noqa: ARG001
) -> tuple[Float[Tensor, "N 3 3"], None]:
    """R S S R' of each Gaussian, [N, 3, 3]; element by element, as small products are slow in BLAS.

    Args:
        quats: wxyz rotations of any length, [N, 4].
        scales: Standard deviations, [N, 3].
        compute_covar: gsplat's flag; covariances are always given.
        compute_preci: gsplat's flag; precisions never are.
        triu: gsplat's flag; matrices are always whole.
    """
    from gsplat.utils import normalized_quat_to_rotmat  # noqa: PLC0415  (as above)

    half = normalized_quat_to_rotmat(normalize(quats, dim=-1)) * scales[:, None, :]
    return (half[:, :, None, :] * half[:, None, :, :]).sum(dim=-1), None


def _coefficients(largest: int) -> Float[Tensor, "n k"]:
    """(-1)^k C(n, k+1) / sqrt(k+1) for n to ``largest``, zero beyond k = n - 1."""
    rows = [
        [(-1) ** k * math.comb(n, k + 1) / math.sqrt(k + 1) for k in range(largest)]
        for n in range(largest + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64)


@contextmanager
def mcmc_on_cpu() -> Iterator[None]:
    """While the block runs, gsplat's MCMC strategy uses these functions."""
    from gsplat.strategy import ops  # noqa: PLC0415  (only MCMC on the CPU needs it)

    before = ops.compute_relocation, ops.quat_scale_to_covar_preci
    ops.compute_relocation, ops.quat_scale_to_covar_preci = compute_relocation, covariances
    try:
        yield
    finally:
        ops.compute_relocation, ops.quat_scale_to_covar_preci = before
