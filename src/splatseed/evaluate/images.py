"""PSNR and SSIM between two images, in PyTorch.

Notation: images are [H, W, 3], values about 0..1.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, pad

from splatseed.evaluate.ssim import C1, C2, WINDOW, l1_and_ssim, window_weights

__all__ = ["psnr", "psnr_within", "ssim", "ssim_of_all"]


def ssim(render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Mean SSIM over the positions where the 11 x 11 window fits entirely, by convolutions."""
    x, y = (image.permute(2, 0, 1).unsqueeze(1) for image in (render, photograph))
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
def ssim_of_all(render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> float:
    """SSIM averaged over all pixels; a mirrored margin lets the window fit everywhere."""
    margin = [WINDOW // 2] * 4
    x, y = (
        pad(image.clamp(0, 1).permute(2, 0, 1), margin, mode="reflect").permute(1, 2, 0)
        for image in (render, photograph)
    )
    if render.device.type != "cpu":
        return float(ssim(x, y))
    return float(l1_and_ssim(x.contiguous().numpy(), y.contiguous().numpy(), 0.0, 1.0)[1])


@torch.no_grad()
def psnr_within(
    render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"]
) -> float | None:
    """PSNR in dB over the pixels of a mask; None if it is empty."""
    if not bool(mask.any()):
        return None
    error = (render.clamp(0, 1) - photograph).square()[mask].mean(dtype=torch.float64)
    return float(-10 * torch.log10(error))


@torch.no_grad()
def psnr(render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio in dB of a render clamped to [0, 1]."""
    error = (render.clamp(0, 1) - photograph).square().mean(dtype=torch.float64)
    return float(-10 * torch.log10(error))
