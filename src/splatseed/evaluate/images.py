"""PSNR and SSIM between two images, in PyTorch.

Notation: images are [H, W, 3], values about 0..1. Promise: on a GPU nothing here waits for it but
what returns a Python number, and SSIM is computed in full float32: cuDNN's default rounds the
inputs of convolutions to ten bits (TF32), and E[x^2] - E[x]^2 then cancels.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d, pad

from splatseed.evaluate.ssim import C1, C2, WINDOW, l1_and_ssim, window_weights


@torch.no_grad()
def l1_and_ssim_by_convolution(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    l1_weight: float,
    ssim_weight: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, "H W 3"]]:
    """``evaluate.ssim.l1_and_ssim`` on any device, by convolutions; its header has the equations.

    Args:
        render: x, values about 0..1; at least 11 pixels a side.
        photograph: y, likewise.
        l1_weight: Weight of the mean absolute difference.
        ssim_weight: Weight of 1 - SSIM.

    Returns:
        Mean |x - y|, mean SSIM where the window fits entirely, and
        d(l1_weight L1 + ssim_weight (1 - SSIM)) / dx.
    """
    x, y = render.permute(2, 0, 1), photograph.permute(2, 0, 1)
    c1, c2 = float(C1), float(C2)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        planes = torch.stack([x, y, x * y, torch.addcmul(y * y, x, x)])
        mean_x, mean_y, e_xy, e_2 = _blur(planes)
        product = mean_x * mean_y
        squares = torch.addcmul(mean_y * mean_y, mean_x, mean_x)
        half_a1 = product + c1 / 2
        half_a2 = (e_xy - product).add_(c2 / 2)
        b1, b2 = squares + c1, (e_2 - squares).add_(c2)
        # dS/de_xy = 2 A1 / (B1 B2), and S is that times A2 / 2.
        inverse = 4 / (b1 * b2)
        by_xy = half_a1 * inverse
        similarity = by_xy * half_a2
        by_2 = similarity / b2  # -dS/de_2
        # dS/dmu_x = 2 mu_y (A2 - A1) / (B1 B2) + 2 S mu_x (1 / B2 - 1 / B1)
        by_mean = torch.addcmul(
            (half_a2 - half_a1).mul_(mean_y).mul_(inverse), mean_x, by_2 - similarity / b1, value=2
        )
        of_mean, of_xy, of_2 = _spread(torch.stack([by_mean, by_xy, by_2]))
    gradient = torch.addcmul(of_mean, y, of_xy).addcmul_(x, of_2, value=-2)
    difference = x - y
    gradient.mul_(-ssim_weight / similarity.numel())
    gradient.add_(difference.sign(), alpha=l1_weight / difference.numel())
    return difference.abs_().mean(), similarity.mean(), gradient.permute(1, 2, 0)


def _blur(planes: Float[Tensor, "P 3 H W"]) -> Float[Tensor, "P 3 H-10 W-10"]:
    """Windowed means where the window fits entirely."""
    across, down = _window(planes.device)
    columns = conv2d(planes.flatten(0, 1).unsqueeze(1), down)
    return conv2d(columns, across).view(
        *planes.shape[:2], *(n - WINDOW + 1 for n in planes.shape[2:])
    )


def _spread(maps: Float[Tensor, "P 3 h w"]) -> Float[Tensor, "P 3 h+10 w+10"]:
    """The transpose of ``_blur``."""
    across, down = _window(maps.device)
    rows = conv_transpose2d(maps.flatten(0, 1).unsqueeze(1), across)
    return conv_transpose2d(rows, down).view(
        *maps.shape[:2], *(n + WINDOW - 1 for n in maps.shape[2:])
    )


@lru_cache
def _window(device: torch.device) -> tuple[Float[Tensor, "1 1 1 11"], Float[Tensor, "1 1 11 1"]]:
    """The window along x and along y, kept on the device: copying it there would wait."""
    weights = torch.from_numpy(window_weights()).to(device)
    return weights.view(1, 1, 1, WINDOW), weights.view(1, 1, WINDOW, 1)


@torch.no_grad()
def ssim_of_all(render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> float:
    """SSIM averaged over all pixels; a mirrored margin lets the window fit everywhere."""
    margin = [WINDOW // 2] * 4
    x, y = (
        pad(image.clamp(0, 1).permute(2, 0, 1), margin, mode="reflect").permute(1, 2, 0)
        for image in (render, photograph)
    )
    if render.device.type != "cpu":
        return float(l1_and_ssim_by_convolution(x, y, 0.0, 1.0)[1])
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
