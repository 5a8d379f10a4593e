"""Compute L1 and SSIM of two images with their gradient.

``_kernels`` has the equations and the notation. ``l1_and_ssim`` is a fast pass on the CPU,
``l1_and_ssim_by_convolution`` the same by PyTorch's convolutions, for any device.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d

from splatseed.splat._kernels import (
    C1,
    C2,
    CHANNELS,
    HALF,
    MARGIN,
    REACH,
    SIGMA,
    STRIP,
    WINDOW,
    backward,
    forward,
)


def window_weights() -> Float32[np.ndarray, " 11"]:
    """Return the one-dimensional Gaussian window, of sum 1."""
    offset = np.arange(WINDOW) - HALF
    weights = np.exp(-(offset**2) / (2 * SIGMA**2))
    return np.asarray(weights / weights.sum(), np.float32)


def l1_and_ssim(
    render: Float32[np.ndarray, "H W 3"],
    photograph: Float32[np.ndarray, "H W 3"],
    l1_weight: float,
    ssim_weight: float,
) -> tuple[float, float, Float32[np.ndarray, "H W 3"]]:
    """Return mean |x - y|, mean SSIM, and d(l1_weight L1 + ssim_weight (1 - SSIM)) / dx.

    Render x and photograph y are contiguous, about 0..1, and at least 11 pixels a side.
    """
    height, width = len(render), render.shape[1] * CHANNELS
    x, y = render.reshape(-1), photograph.reshape(-1)
    positions = (height - MARGIN) * (width - REACH)
    partials = _zero_padded(height, width)
    ssim_sums = np.empty(-(-(height - MARGIN) // STRIP), np.float64)
    l1_sums = np.empty(-(-height // STRIP), np.float64)
    gradient = np.empty_like(x)
    weights = window_weights()[: HALF + 1]
    forward(x, y, width, weights, partials, ssim_sums)
    scales = np.array([-ssim_weight / positions, l1_weight / x.size], np.float32)
    backward(x, y, width, weights, partials, scales, l1_sums, gradient)
    l1, ssim = l1_sums.sum() / x.size, ssim_sums.sum() / positions
    return float(l1), float(ssim), gradient.reshape(render.shape)


def _zero_padded(height: int, width: int) -> Float32[np.ndarray, "3 H+11 W*3+30"]:
    """Allocate the three derivative maps, padded with zeros by the reach of the window.

    ``width`` is W * 3. The padding at the right stays uninitialised: ``forward`` clears it.
    """
    # The extra row at the end lets whole vectors read past the row before it.
    partials = np.empty((3, height + MARGIN + 1, width + REACH), np.float32)
    partials[:, :MARGIN] = 0.0
    partials[:, height:] = 0.0
    partials[:, :, :REACH] = 0.0
    return partials


@torch.no_grad()
def l1_and_ssim_by_convolution(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    l1_weight: float,
    ssim_weight: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, "H W 3"]]:
    """Compute ``splat.ssim.l1_and_ssim`` by convolutions."""
    x, y = render.permute(2, 0, 1), photograph.permute(2, 0, 1)
    c1, c2 = float(C1), float(C2)
    # cuDNN's TF32 would round inputs to ten bits, and E[x^2] - E[x]^2 cancel.
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


def ssim_map(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> Float[Tensor, "3 H-10 W-10"]:
    """Return SSIM wherever the window fits."""
    x, y = x.permute(2, 0, 1), y.permute(2, 0, 1)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        mean_x, mean_y, e_xy, e_2 = _blur(torch.stack([x, y, x * y, x * x + y * y]))
    product, squares = mean_x * mean_y, mean_x**2 + mean_y**2
    c1, c2 = float(C1), float(C2)
    upper = (2 * product + c1) * (2 * (e_xy - product) + c2)
    ssim: Tensor = upper / ((squares + c1) * (e_2 - squares + c2))
    return ssim


def _blur(planes: Float[Tensor, "P 3 H W"]) -> Float[Tensor, "P 3 H-10 W-10"]:
    """Return windowed means wherever the window fits."""
    across, down = _window(planes.device)
    blurred = conv2d(conv2d(planes.flatten(0, 1).unsqueeze(1), down), across)
    return blurred.view(*planes.shape[:2], *blurred.shape[2:])


def _spread(maps: Float[Tensor, "P 3 h w"]) -> Float[Tensor, "P 3 h+10 w+10"]:
    """Apply the transpose of ``_blur``."""
    across, down = _window(maps.device)
    spread = conv_transpose2d(conv_transpose2d(maps.flatten(0, 1).unsqueeze(1), across), down)
    return spread.view(*maps.shape[:2], *spread.shape[2:])


@lru_cache
def _window(device: torch.device) -> tuple[Float[Tensor, "1 1 1 11"], Float[Tensor, "1 1 11 1"]]:
    """Return the window along x and y on the device, cached: copying it would synchronise."""
    weights = torch.from_numpy(window_weights()).to(device)
    return weights.view(1, 1, 1, WINDOW), weights.view(1, 1, WINDOW, 1)
