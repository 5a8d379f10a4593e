"""The loss of 3DGS, (1 - s) L1 + s (1 - SSIM) with s = 0.2.

Notation: images are [H, W, 3], values about 0..1. Promise: on the CPU the loss and its gradient
come from one Numba pass and do not depend on the number of threads; on CUDA from PyTorch's
convolutions, which compute the same (that code runs on the CPU too, and the tests compare them).
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.evaluate.images import ssim
from splatseed.evaluate.ssim import l1_and_ssim

__all__ = ["SSIM_WEIGHT", "photometric_loss"]

SSIM_WEIGHT = 0.2


def photometric_loss(
    render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]
) -> Float[Tensor, ""]:
    """0.8 L1 + 0.2 (1 - SSIM), differentiable in ``render`` (Kerbl et al. 2023, eq. 7).

    Args:
        render: The rendered view, float32; at least 11 pixels a side.
        photograph: The view as captured, likewise.
    """
    if render.device.type == "cpu":
        loss: Tensor = _CpuLoss.apply(render, photograph)
        return loss
    l1 = (render - photograph).abs().mean()
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim(render, photograph))


class _CpuLoss(torch.autograd.Function):
    """The loss, whose gradient is computed along with it, as it ends the graph."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, photograph: Tensor) -> Tensor:
        l1, similarity, gradient = l1_and_ssim(
            render.detach().contiguous().numpy(),
            photograph.contiguous().numpy(),
            1 - SSIM_WEIGHT,
            SSIM_WEIGHT,
        )
        ctx.save_for_backward(torch.from_numpy(gradient))
        return torch.tensor((1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - similarity))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        # backward mostly starts at the loss, and multiplying by one takes a whole pass.
        return gradient if float(upstream[0]) == 1.0 else gradient * upstream[0], None
