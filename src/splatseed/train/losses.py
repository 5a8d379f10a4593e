"""The loss of 3DGS, (1 - s) L1 + s (1 - SSIM) with s = 0.2, and its parts.

Notation: images are [H, W, 3], values about 0..1. Promise: on the CPU the loss and its gradient come
from one Numba pass and do not depend on the number of threads; on CUDA from PyTorch's convolutions,
which compute the same (that code runs on the CPU too, and the tests compare them).
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

from splatseed.train.ssim import C1, C2, WINDOW, l1_and_ssim, window_weights

__all__ = ["SSIM_WEIGHT", "photometric_loss", "psnr", "ssim"]

SSIM_WEIGHT = 0.2


def photometric_loss(
    render: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]
) -> Float[Tensor, ""]:
    """0.8 L1 + 0.2 (1 - SSIM), differentiable in ``render`` (Kerbl et al. 2023, eq. 7).

    Args:
        render: What the Gaussians look like, float32; at least 11 pixels a side.
        truth: The photograph.
    """
    if render.device.type == "cpu":
        loss: Tensor = _CpuLoss.apply(render, truth)
        return loss
    l1 = (render - truth).abs().mean()
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim(render, truth))


def ssim(render: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Mean SSIM over the places where the 11 x 11 window fits whole, by convolutions."""
    x, y = (image.permute(2, 0, 1).unsqueeze(1) for image in (render, truth))
    weights = torch.from_numpy(window_weights()).to(render)
    mean_x, mean_y, e_xy, e_2 = (
        conv2d(conv2d(image, weights.view(1, 1, WINDOW, 1)), weights.view(1, 1, 1, WINDOW))
        for image in (x, y, x * y, x * x + y * y)
    )
    product, squares = mean_x * mean_y, mean_x**2 + mean_y**2
    c1, c2 = float(C1), float(C2)
    above = (2 * product + c1) * (2 * (e_xy - product) + c2)
    below = (squares + c1) * (e_2 - squares + c2)
    return (above / below).mean()


@torch.no_grad()
def psnr(render: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio in dB of a render clamped to [0, 1]."""
    error = (render.clamp(0, 1) - truth).square().mean(dtype=torch.float64)
    return float(-10 * torch.log10(error))


class _CpuLoss(torch.autograd.Function):
    """The loss and, at once, its gradient: the loss is the end of the graph."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, truth: Tensor) -> Tensor:
        l1, similarity, gradient = l1_and_ssim(
            render.detach().contiguous().numpy(),
            truth.contiguous().numpy(),
            1 - SSIM_WEIGHT,
            SSIM_WEIGHT,
        )
        ctx.save_for_backward(torch.from_numpy(gradient))
        return torch.tensor((1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - similarity))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        # The loss is most often where backward begins, and multiplying by one takes a pass.
        return gradient if float(upstream[0]) == 1.0 else gradient * upstream[0], None
