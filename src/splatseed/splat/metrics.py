"""PSNR, SSIM and FLIP of two images [H, W, 3] of values in about [0, 1], in PyTorch.

On a GPU, only functions that return a Python number synchronise.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor
from torch.nn.functional import pad

from splatseed.requirements import require
from splatseed.splat._kernels import WINDOW
from splatseed.splat.ssim import l1_and_ssim, l1_and_ssim_by_convolution, ssim_map

_UNSATURATED = 0.5 / 255
"""Minimum distance from 0 and 1 of an unclipped value."""
_CORRECTIONS = 5
"""Number of colour fits: after each fit, other pixels are saturated."""
_BLOCK = 1 << 15
"""Pixels that are fitted at a time on the CPU: their terms stay in its cache."""


@torch.no_grad()
def psnr(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Return the PSNR in dB of a render clamped to [0, 1], over the pixels of a mask.

    NaN if the mask is empty.
    """
    error = (render.clamp(0, 1) - photograph).square()
    error = error if mask is None else error[mask]
    if not error.numel():
        return math.nan
    if error.device.type == "cpu":  # PyTorch's mean depends on the number of threads
        mean = float(np.mean(error.numpy(), dtype=np.float64))
    else:
        mean = float(error.mean(dtype=torch.float64))
    return -10 * math.log10(mean) if mean else math.inf


@torch.no_grad()
def color_corrected(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Fit a render's colours to the photograph's.

    Each channel becomes a quadratic polynomial of the render's three channels, fitted by least
    squares over the pixels of the mask that are saturated in neither image; the fit is repeated on
    its result. This is multinerf's ``color_correct`` (Barron et al. 2022) and gsplat's
    ``color_correct_quadratic``, in double precision. Of equally good polynomials the one of
    smallest norm is chosen, so that a render of a single colour has a solution.
    """
    pair = (render.clamp(0, 1), photograph)
    x, y = (image.reshape(-1, 3).T.double().contiguous() for image in pair)
    usable = _unsaturated(x) & _unsaturated(y)
    if mask is not None:
        usable &= mask.reshape(-1)
    size = _BLOCK if x.device.type == "cpu" else len(usable[0])
    for _ in range(_CORRECTIONS):
        normal, right = x.new_zeros((3, 10, 10)), x.new_zeros((3, 10, 1))
        for source, target, valid in zip(
            *(each.split(size, 1) for each in (x, y, usable)), strict=True
        ):
            terms = _quadratic_terms(source)
            known = terms * (valid & _unsaturated(source))[:, None]
            normal += known @ terms.T
            right += known @ target[:, :, None]
        fits = torch.linalg.pinv(normal, rtol=1e-12, hermitian=True) @ right
        fitted = [fits[..., 0] @ _quadratic_terms(source) for source in x.split(size, 1)]
        x = torch.cat(fitted, dim=1).clamp(0, 1)
    return x.T.reshape(render.shape).to(render.dtype)


def _quadratic_terms(x: Float[Tensor, "3 P"]) -> Float[Tensor, "10 P"]:
    """Return the monomials of degree 2 or less of each pixel's colour."""
    r, g, b = x
    return torch.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, torch.ones_like(r)])


def _unsaturated(values: Float[Tensor, "3 P"]) -> Bool[Tensor, "3 P"]:
    return (values >= _UNSATURATED) & (values <= 1 - _UNSATURATED)


@torch.no_grad()
def mirrored_ssim(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Return the mean SSIM over all pixels, or those of a mask, with mirrored edges.

    Masked pixels of the render should be the photograph's (``photographs.fill_masked``).
    """
    margin = [WINDOW // 2] * 4
    x, y = (
        pad(image.clamp(0, 1).permute(2, 0, 1), margin, mode="reflect").permute(1, 2, 0)
        for image in (render, photograph)
    )
    if mask is not None:
        return float(ssim_map(x, y)[:, mask].mean())
    if render.device.type != "cpu":
        return float(l1_and_ssim_by_convolution(x, y, 0.0, 1.0)[1])
    return float(l1_and_ssim(x.contiguous().numpy(), y.contiguous().numpy(), 0.0, 1.0)[1])


@torch.no_grad()
def flip_map(
    render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """Return FLIP of each pixel, 0 to 1: the visible difference when images alternate.

    LDR-FLIP at 67 pixels per degree of visual angle, computed on the CPU by its authors' package
    (Andersson et al. 2020). Images are sRGB, clamped to [0, 1].
    """
    require("flip_evaluator")
    from flip_evaluator import evaluate  # noqa: PLC0415  (optional: extra `train`)

    images = (each.clamp(0, 1).cpu().contiguous().numpy() for each in (photograph, render))
    errors, _, _ = evaluate(*images, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(errors[..., 0])
