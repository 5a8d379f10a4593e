"""Run gsplat's MCMC strategy on either device: relocation and covariances for CPU tensors.

Notation: o opacity, s scales, n the number of Gaussians at the same position. With
o' = 1 - (1 - o)^(1/n) (3DGS as MCMC, Kheradmand et al. 2024, eq. 9; the double sum simplified by
the hockey-stick identity):

    s' = s o / sum_{k=0}^{n-1} (-1)^k C(n, k+1) o'^(k+1) / sqrt(k+1)

gsplat 1.5.3 implements both in CUDA only and has no hook for another implementation: its strategy
reads them from the module ``gsplat.strategy.ops``. So ``mcmc_on_cpu`` replaces the module's
functions while a block runs. ``tests/rendering/test_strategies.py`` fails once gsplat reads them
elsewhere or accepts CPU tensors; then this file can be removed. Promise: float64 inside, because
the sum alternates; gsplat's files are unchanged; CUDA tensors go to gsplat's own functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import gsplat
import torch
from gsplat.strategy import ops
from gsplat.utils import normalized_quat_to_rotmat
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize


def compute_relocation(
    opacities: Float[Tensor, " N"] | Float[Tensor, "N 1"],
    scales: Float[Tensor, "N 3"],
    ratios: Int[Tensor, " N"],
    binoms: Float[Tensor, "M M"],
) -> tuple[Tensor, Float[Tensor, "N 3"]]:
    """Compute opacities and scales [N, 3] for replacing each Gaussian by ``ratios`` equal copies.

    The opacities keep their shape. Ratios are clamped to M, the size of gsplat's binomial table.
    """
    if opacities.is_cuda:
        from gsplat.relocation import compute_relocation as on_cuda  # noqa: PLC0415  (needs CUDA)

        return on_cuda(opacities, scales, ratios, binoms)  # type: ignore[no-any-return]  # gsplat is untyped
    largest = len(binoms)
    shares = ratios.clamp(1, largest).view_as(opacities)  # the table ends at M
    old = opacities.to(torch.float64)
    # 1 - (1 - o)^(1/n), without losing the digits of a small o
    new = -torch.expm1(torch.log1p(-old) / shares)
    table = _coefficients(largest).to(old.device)
    total = torch.zeros_like(old)
    for k in reversed(range(largest)):  # Horner's rule
        total = (total + table[shares, k]) * new
    # A Gaussian without copies keeps its exact size.
    factor = torch.where(shares == 1, 1.0, old / total)
    return new.to(opacities.dtype), scales * factor.to(scales.dtype).view(-1, 1)


def covariances(
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    compute_covar: bool = True,
    compute_preci: bool = False,
    triu: bool = False,
) -> tuple[Float[Tensor, "N 3 3"], None]:
    """Return R S S R' of each Gaussian, [N, 3, 3], from wxyz rotations of any length.

    The flags are gsplat's. On the CPU, covariances are always full, and precisions never computed.
    """
    if quats.is_cuda:
        return gsplat.quat_scale_to_covar_preci(quats, scales, compute_covar, compute_preci, triu)  # type: ignore[no-any-return]  # gsplat is untyped
    # Written out, because small products are slow in BLAS.
    half = normalized_quat_to_rotmat(normalize(quats, dim=-1)) * scales[:, None, :]
    return (half[:, :, None, :] * half[:, None, :, :]).sum(dim=-1), None


def _coefficients(largest: int) -> Float[Tensor, "n k"]:
    """Return (-1)^k C(n, k+1) / sqrt(k+1) for n to ``largest``, zero beyond k = n - 1."""
    rows = [
        [(-1) ** k * math.comb(n, k + 1) / math.sqrt(k + 1) for k in range(largest)]
        for n in range(largest + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64)


_LOCK = Lock()
_REPLACED: list[tuple[Any, Any]] = []
"""Functions replaced by the running blocks of all threads; gsplat's own first."""


@contextmanager
def mcmc_on_cpu() -> Iterator[None]:
    """Let gsplat's ``MCMCStrategy`` accept CPU tensors while the block runs.

    Code that uses this class or a subclass needs no change: run its training loop in the block.
    Blocks may be nested and run in several threads.
    """
    with _LOCK:
        _REPLACED.append((ops.compute_relocation, ops.quat_scale_to_covar_preci))
        ops.compute_relocation, ops.quat_scale_to_covar_preci = compute_relocation, covariances
    try:
        yield
    finally:
        with _LOCK:
            ops.compute_relocation, ops.quat_scale_to_covar_preci = _REPLACED.pop()


class MCMCStrategy(gsplat.MCMCStrategy):  # type: ignore[misc]  # gsplat has no types
    """gsplat's ``MCMCStrategy``, for CPU tensors too."""

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """Run gsplat's step after the optimisers; params, optimizers, state, step, info, lr."""
        with mcmc_on_cpu():
            super().step_post_backward(*args, **kwargs)
