"""Rendering Gaussians from a view, and the photograph they are compared with.

Notation: gsplat's parameter dict as tensors: ``means``, ``scales`` (logarithms), ``quats``,
``opacities`` (logits), ``sh0``, ``shN``. Promise: one rasteriser call serves training and scoring
on CPU and CUDA alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.render import rasterization
from splatseed.views.view import View

__all__ = ["photograph_of", "render_features", "render_view"]


def render_view(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict, view: View, sh_degree: int
) -> tuple[Float[Tensor, "H W 3"], dict[str, Any]]:
    """The render of a view, and the rasteriser's ``info``.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: The view whose camera is used.
        sh_degree: Degree of spherical harmonics in use; coefficients beyond it are ignored.
    """
    images, info = _rasterize(params, view, _harmonics(params, sh_degree), sh_degree)
    return images, info


def render_features(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    features: Float[Tensor, "N D"],
) -> Float[Tensor, "H W D"]:
    """The Gaussians rendered with arbitrary features in place of colours."""
    return _rasterize(params, view, features, None)[0]


def _rasterize(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    colors: Tensor | tuple[Tensor, Tensor],
    sh_degree: int | None,
) -> tuple[Float[Tensor, "H W D"], dict[str, Any]]:
    means = params["means"]
    images, _, info = rasterization(
        means=means,
        quats=params["quats"],
        scales=torch.exp(params["scales"]),
        opacities=torch.sigmoid(params["opacities"]),
        colors=colors,
        viewmats=_on_device(view.cam_from_world, means)[None],
        Ks=_on_device(view.K, means)[None],
        width=view.width,
        height=view.height,
        sh_degree=sh_degree,
        packed=False,
    )
    return images.squeeze(0), info  # unlike indexing, its backward allocates no image of zeros


def photograph_of(view: View, device: torch.device) -> Float[Tensor, "H W 3"]:
    """The view's photograph as float32 from 0 to 1."""
    # A copy: PyTorch warns on stderr about read-only arrays, which a view's may be.
    return torch.tensor(view.photograph, device=device).to(torch.float32).div_(255.0)


def _harmonics(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict, sh_degree: int
) -> Tensor | tuple[Tensor, Tensor]:
    """The coefficients in use; unused ones would cost copies and optimiser steps for nothing."""
    return params["sh0"] if sh_degree == 0 else (params["sh0"], params["shN"])


def _on_device(matrix: np.ndarray, like: Tensor) -> Tensor:
    return torch.from_numpy(np.asarray(matrix, np.float32)).to(like.device)
