"""The trained parameters in PyTorch, their optimisers, and what they look like from a view.

Notation: gsplat's parameter dict: ``means``, ``scales`` (logarithms), ``quats``, ``opacities``
(logits), ``sh0``, ``shN``; one Adam each, as gsplat's strategies need them. Promise: one rasteriser
call serves training and scoring on CPU and CUDA alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.render import rasterization
from splatseed.train.frame import SCENE_SCALE
from splatseed.train.gaussians import Gaussians
from splatseed.train.settings import LEARNING_RATES
from splatseed.train.views import View

__all__ = [
    "MEANS_LR",
    "Optimizers",
    "Parameters",
    "gaussians_of",
    "make_optimizers",
    "make_parameters",
    "photograph",
    "render_view",
]

Parameters = torch.nn.ParameterDict
Optimizers = dict[str, torch.optim.Optimizer]

ADAM_EPSILON = 1e-15
MEANS_LR = LEARNING_RATES["means"] * SCENE_SCALE
"""The first learning rate of positions, in the training frame."""


def make_parameters(gaussians: Gaussians, device: torch.device) -> Parameters:
    """Trainable copies of the Gaussians' arrays on a device."""
    return Parameters(
        {
            name: torch.nn.Parameter(torch.tensor(array, device=device))
            for name, array in gaussians.arrays().items()
        }
    )


def gaussians_of(params: Parameters | Mapping[str, Tensor]) -> Gaussians:
    """The parameters as NumPy arrays (those of the CPU share their memory)."""
    return Gaussians(**{name: value.detach().cpu().numpy() for name, value in params.items()})


def make_optimizers(params: Parameters) -> Optimizers:
    """One Adam a parameter, with 3DGS's learning rates."""
    rates = {**LEARNING_RATES, "means": MEANS_LR}
    return {
        name: torch.optim.Adam([{"params": [value]}], lr=rates[name], eps=ADAM_EPSILON, fused=True)
        for name, value in params.items()
    }


def render_view(
    params: Parameters | Mapping[str, Tensor], view: View, sh_degree: int
) -> tuple[Float[Tensor, "H W 3"], dict[str, Any]]:
    """What the Gaussians look like from a view, and the rasteriser's ``info``.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: Whose camera is used.
        sh_degree: Degree of spherical harmonics in use; coefficients beyond it are left out.
    """
    means = params["means"]
    images, _, info = rasterization(
        means=means,
        quats=params["quats"],
        scales=torch.exp(params["scales"]),
        opacities=torch.sigmoid(params["opacities"]),
        colors=_harmonics(params, sh_degree),
        viewmats=_on_device(view.cam_from_world, means)[None],
        Ks=_on_device(view.K, means)[None],
        width=view.width,
        height=view.height,
        sh_degree=sh_degree,
        packed=False,
    )
    return images.squeeze(0), info  # unlike an index, backward makes no image of zeros of it


def photograph(view: View, device: torch.device) -> Float[Tensor, "H W 3"]:
    """The view's pixels as float32 from 0 to 1."""
    # A copy: PyTorch warns on stderr of arrays that are read-only, as a view's may be.
    return torch.tensor(view.image, device=device).to(torch.float32).div_(255.0)


def _harmonics(
    params: Parameters | Mapping[str, Tensor], sh_degree: int
) -> Tensor | tuple[Tensor, Tensor]:
    """The coefficients in use: idle ones would be copied and optimised all the same."""
    return params["sh0"] if sh_degree == 0 else (params["sh0"], params["shN"])


def _on_device(matrix: np.ndarray, like: Tensor) -> Tensor:
    return torch.from_numpy(np.asarray(matrix, np.float32)).to(like.device)
