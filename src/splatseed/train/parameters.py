"""The trained parameters in PyTorch, their optimisers, and what they look like from a view.

Notation: gsplat's parameter dict: ``means``, ``scales`` (logarithms), ``quats``, ``opacities``
(logits), ``sh0``, ``shN``; one Adam each, as gsplat's strategies need them. Beside them stand, in
splatseed's conventions, ``near_depths`` [N], which are not learnt: whatever adds, moves or removes
Gaussians hands them on with the rest. Promise: one rasteriser call serves training and scoring on
CPU and CUDA alike.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseed.render import rasterization
from splatseed.train.frame import SCENE_SCALE
from splatseed.train.gaussians import Gaussians
from splatseed.train.schedule import Schedule
from splatseed.views.view import View

__all__ = [
    "NEAR_DEPTHS",
    "Optimizers",
    "Parameters",
    "as_parameters",
    "gaussians_of",
    "make_optimizers",
    "make_parameters",
    "optimize",
    "photograph",
    "render_features",
    "render_view",
    "yardsticks",
]

Parameters = torch.nn.ParameterDict
Optimizers = dict[str, torch.optim.Optimizer]

ADAM_BETA1 = 0.9
ADAM_EPSILON = 1e-15
NEAR_DEPTHS = "near_depths"


def make_parameters(
    gaussians: Gaussians,
    device: torch.device,
    near_depths: Float32[np.ndarray, " N"] | None = None,
) -> Parameters:
    """Trainable copies of the Gaussians' arrays on a device, and their yardsticks beside them.

    Args:
        gaussians: The first ones.
        device: Where they are trained.
        near_depths: Their near depths; left out, the cameras' extent is the yardstick of all.
    """
    arrays = gaussians.arrays()
    if near_depths is not None:
        arrays[NEAR_DEPTHS] = near_depths
    return as_parameters({name: torch.tensor(each, device=device) for name, each in arrays.items()})


def as_parameters(tensors: Mapping[str, Tensor]) -> Parameters:
    """The parameter dict of these tensors: near depths are kept, all else is learnt."""
    return Parameters(
        {
            name: torch.nn.Parameter(value, requires_grad=name != NEAR_DEPTHS)
            for name, value in tensors.items()
        }
    )


def gaussians_of(params: Parameters | Mapping[str, Tensor]) -> Gaussians:
    """The parameters as NumPy arrays (those of the CPU share their memory)."""
    names = (field.name for field in dataclasses.fields(Gaussians))
    return Gaussians(**{name: params[name].detach().cpu().numpy() for name in names})


def yardsticks(params: Parameters) -> Float[Tensor, "#N"]:
    """The length that each Gaussian's size and rate are measured by; one number if it is all's."""
    if NEAR_DEPTHS in params:
        lengths: Tensor = params[NEAR_DEPTHS].detach()
    else:
        lengths = params["means"].new_full((1,), SCENE_SCALE)
    return lengths


def make_optimizers(params: Parameters, schedule: Schedule) -> Optimizers:
    """One Adam a parameter, with the schedule's learning rates."""
    betas = (ADAM_BETA1, schedule.beta2)
    return {
        name: torch.optim.Adam(
            [{"params": [value]}],
            lr=schedule.learning_rates[name],
            betas=betas,
            eps=ADAM_EPSILON,
            fused=True,
        )
        for name, value in params.items()
        if value.requires_grad
    }


def optimize(params: Parameters, optimizers: Optimizers, rates: Mapping[str, float]) -> None:
    """Take the step that the gradients ask for, and clear them.

    Args:
        params: With their gradients.
        optimizers: Theirs.
        rates: Their learning rates; that of positions in yardsticks.
    """
    means, lengths = params["means"], yardsticks(params)
    positions = means.data
    means.data = torch.zeros_like(positions)  # a step from 0 loses no digits, however far off it is
    for name, optimizer in optimizers.items():
        optimizer.param_groups[0]["lr"] = rates[name]
        optimizer.step()
        optimizer.zero_grad()
    # Adam's step is in proportion to its rate, so it can be scaled afterwards; an axis at a time,
    # as PyTorch broadcasts over rows of three half as fast.
    for axis in range(3):
        positions[:, axis].addcmul_(means.data[:, axis], lengths)
    means.data = positions


def render_view(
    params: Parameters | Mapping[str, Tensor], view: View, sh_degree: int
) -> tuple[Float[Tensor, "H W 3"], dict[str, Any]]:
    """What the Gaussians look like from a view, and the rasteriser's ``info``.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: Whose camera is used.
        sh_degree: Degree of spherical harmonics in use; coefficients beyond it are left out.
    """
    images, info = _rasterize(params, view, _harmonics(params, sh_degree), sh_degree)
    return images, info


def render_features(
    params: Parameters | Mapping[str, Tensor], view: View, features: Float[Tensor, "N D"]
) -> Float[Tensor, "H W D"]:
    """What the Gaussians look like from a view if these numbers, whatever they mean, are their colours."""
    return _rasterize(params, view, features, None)[0]


def _rasterize(
    params: Parameters | Mapping[str, Tensor],
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
