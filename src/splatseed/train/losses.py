"""The loss of 3DGS, (1 - s) L1 + s (1 - SSIM) with s = 0.2.

Notation: images are [H, W, 3], values about 0..1. Promise: the gradient is computed along with the
loss, which ends the graph: on the CPU in one Numba pass, whose bytes do not depend on the number of
threads; on a GPU by a few convolutions without TF32, or by the fused kernel of the package
``fused-ssim`` where it is installed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.splat.metrics import l1_and_ssim_by_convolution
from splatseed.splat.ssim import l1_and_ssim

SSIM_WEIGHT = 0.2


def photometric_loss(
    render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]
) -> Float[Tensor, ""]:
    """0.8 L1 + 0.2 (1 - SSIM), differentiable in ``render`` (Kerbl et al. 2023, eq. 7).

    Args:
        render: The rendered view, float32; at least 11 pixels a side.
        photograph: The view as captured, likewise.
    """
    fused = _fused_ssim() if render.is_cuda else None
    if fused is None:
        loss: Tensor = _Loss.apply(render, photograph)
        return loss
    l1 = (render - photograph).abs().mean()
    x, y = (image.permute(2, 0, 1)[None].contiguous() for image in (render, photograph))
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - fused(x, y, padding="valid"))


@lru_cache
def _fused_ssim() -> Callable[..., Tensor] | None:
    """The function of the package fused-ssim, None without it."""
    try:
        from fused_ssim import fused_ssim  # noqa: PLC0415  (optional)
    except ImportError:
        return None
    return fused_ssim  # type: ignore[no-any-return]  # it has no types


class _Loss(torch.autograd.Function):
    """The loss, with the analytic gradient of both of its parts."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, photograph: Tensor) -> Tensor:
        weights = 1 - SSIM_WEIGHT, SSIM_WEIGHT
        if render.device.type == "cpu":
            arrays = render.detach().contiguous().numpy(), photograph.contiguous().numpy()
            l1, similarity, slopes = l1_and_ssim(*arrays, *weights)
            ctx.save_for_backward(torch.from_numpy(slopes))
            return torch.tensor(weights[0] * l1 + weights[1] * (1 - similarity))
        of_l1, of_ssim, gradient = l1_and_ssim_by_convolution(render, photograph, *weights)
        ctx.save_for_backward(gradient)
        return weights[0] * of_l1 + weights[1] * (1 - of_ssim)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        # backward mostly starts at the loss, and multiplying by one takes a whole pass; on a GPU
        # looking at the number would wait.
        at_loss = gradient.device.type == "cpu" and float(upstream[0]) == 1.0
        return gradient if at_loss else gradient * upstream[0], None
