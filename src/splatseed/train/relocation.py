"""How MCMC splits a Gaussian into several that look like it: the formula that gsplat has in CUDA.

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

__all__ = ["compute_relocation", "relocation_on_cpu"]


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


def _coefficients(largest: int) -> Float[Tensor, "n k"]:
    """(-1)^k C(n, k+1) / sqrt(k+1) for n to ``largest``, zero beyond k = n - 1."""
    rows = [
        [(-1) ** k * math.comb(n, k + 1) / math.sqrt(k + 1) for k in range(largest)]
        for n in range(largest + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64)


@contextmanager
def relocation_on_cpu() -> Iterator[None]:
    """While the block runs, gsplat's MCMC strategy uses this formula."""
    from gsplat.strategy import ops  # noqa: PLC0415  (only MCMC on the CPU needs it)

    original = ops.compute_relocation
    ops.compute_relocation = compute_relocation
    try:
        yield
    finally:
        ops.compute_relocation = original
