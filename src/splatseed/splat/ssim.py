"""Compute L1 and SSIM of two images with their gradient, on the CPU.

``_kernels`` has the equations and the notation; ``ssim_conv`` has the same for any device.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from splatseed.splat._kernels import (
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
