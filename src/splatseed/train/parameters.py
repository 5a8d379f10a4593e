"""The trained parameters in PyTorch, and their optimisers.

Notation: gsplat's parameter dict: ``means``, ``scales`` (logarithms), ``quats``, ``opacities``
(logits), ``sh0``, ``shN``; one Adam each, as gsplat's strategies need them. Beside them stand, in
splatseed's conventions, ``near_depths`` [N], which are not learnt: whatever adds, moves or removes
Gaussians hands them on with the rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseed.splat.frame import SCENE_SCALE
from splatseed.splat.gaussians import Gaussians
from splatseed.train.schedule import Schedule

__all__ = [
    "NEAR_DEPTHS",
    "Optimizers",
    "Parameters",
    "as_parameters",
    "gaussians_of",
    "make_optimizers",
    "make_parameters",
    "optimize",
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
