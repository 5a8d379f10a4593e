"""The trained parameters in PyTorch, their optimisers, and their mean over the end of a run.

Notation: gsplat's parameter dict: ``means``, ``scales`` (logarithms), ``quats``, ``opacities``
(logits), ``sh0``, ``shN``; one Adam each, as gsplat's strategies need them. In splatseed's
conventions they are accompanied by ``near_depths`` [N], which are not learnt: whatever adds, moves
or removes Gaussians treats them like the rest. Steps on single photographs keep the parameters
oscillating; their mean does not oscillate (Polyak and Juditsky, 1992).
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseed.splat.gaussians import PARAMETERS, SCENE_SCALE, Gaussians
from splatseed.splat.rendering import opacities_of
from splatseed.training.schedule import Schedule

Parameters = torch.nn.ParameterDict
Optimizers = dict[str, torch.optim.Optimizer]

ADAM_BETA1 = 0.9
"""Decay of Adam's mean gradient, PyTorch's default."""
ADAM_EPSILON = 1e-15
"""3DGS's: far below any gradient, so that rarely seen Gaussians take full steps too."""
NEAR_DEPTHS = "near_depths"
DROPPED, MOST_OPAQUE = -20.0, 0.995
"""The logit of an opacity that no pixel shows, and the highest opacity of a Gaussian that stays."""


def make_parameters(
    gaussians: Gaussians, device: torch.device, near_depths: Float32[np.ndarray, " N"] | None = None
) -> Parameters:
    """Trainable copies of the Gaussians' arrays on a device.

    Without ``near_depths``, their length units, the cameras' extent is the unit for all.
    """
    arrays = gaussians.arrays()
    if near_depths is not None:
        arrays[NEAR_DEPTHS] = near_depths
    return as_parameters({name: torch.tensor(each, device=device) for name, each in arrays.items()})


def as_parameters(tensors: Mapping[str, Tensor]) -> Parameters:
    """The parameter dict of these tensors: near depths are constant, all else is learnt."""
    return Parameters(
        {
            name: torch.nn.Parameter(value, requires_grad=name != NEAR_DEPTHS)
            for name, value in tensors.items()
        }
    )


def gaussians_of(params: Parameters | Mapping[str, Tensor]) -> Gaussians:
    """The parameters as NumPy arrays (sharing memory on the CPU)."""
    arrays: dict[str, Any] = {name: params[name].detach().cpu().numpy() for name in PARAMETERS}
    return Gaussians(**arrays)


def length_units(params: Parameters) -> Float[Tensor, "#N"]:
    """The unit of each Gaussian's size and learning rate; a single number if all share it."""
    if NEAR_DEPTHS in params:
        lengths: Tensor = params[NEAR_DEPTHS].detach()
    else:
        lengths = params["means"].new_full((1,), SCENE_SCALE)
    return lengths


class _Adam(torch.optim.Adam):
    """Adam whose methods do not import torch.compile, a fifth of what it takes to start training.

    PyTorch 2.13 imports it at their first call, to exempt them from being compiled.
    """

    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)


def make_optimizers(params: Parameters, schedule: Schedule) -> Optimizers:
    """One Adam per parameter, with the schedule's learning rates."""
    betas = ADAM_BETA1, schedule.beta2
    return {
        name: _Adam([value], schedule.learning_rates[name], betas, ADAM_EPSILON, fused=True)
        for name, value in params.items()
        if value.requires_grad
    }


def optimize(params: Parameters, optimizers: Optimizers, rates: Mapping[str, float]) -> None:
    """Take an optimiser step at these rates, in length units for positions; clear gradients."""
    means, lengths = params["means"], length_units(params)
    positions = means.data
    # A step from 0 loses no digits, however distant the position.
    means.data = torch.zeros_like(positions)
    for name, optimizer in optimizers.items():
        optimizer.param_groups[0]["lr"] = rates[name]
        optimizer.step()
        optimizer.zero_grad()
    # Adam's step is proportional to its rate, so it can be scaled afterwards; one axis at a time,
    # because PyTorch broadcasts over rows of three at half the speed.
    for axis in range(3):
        positions[:, axis].addcmul_(means.data[:, axis], lengths)
    means.data = positions


def with_dropout(params: Parameters, fraction: float) -> Parameters | Mapping[str, Tensor]:
    """The parameters with a random ``fraction`` of the Gaussians dropped, by PyTorch's generator.

    The other opacities are multiplied by 1 / (1 - fraction), which keeps their mean; only they
    receive gradients (H. Park et al., "DropGaussian", 2025).
    """
    if fraction <= 0:
        return params
    opacities = opacities_of(params["opacities"])
    kept = torch.rand_like(opacities) >= fraction
    raised = torch.logit((opacities / (1 - fraction)).clamp(max=MOST_OPAQUE))
    return {**params, "opacities": torch.where(kept, raised, DROPPED)}


@torch.no_grad()
def add_to_mean(mean: dict[str, Any], params: Parameters) -> None:
    """Add the learnt parameters to their means by name, and 1 to ``count``; empty at first.

    It restarts when the number of Gaussians changes, so that each value averages one Gaussian.
    """
    if not mean or len(mean["means"]) != len(params["means"]):
        mean.clear()
        mean["count"] = 0
    mean["count"] += 1
    for name, value in params.items():
        if name in mean:
            # m_n = m_(n-1) + (x - m_(n-1)) / n
            mean[name].lerp_(value, 1.0 / mean["count"])
        elif value.requires_grad:
            mean[name] = value.detach().clone()


@torch.no_grad()
def take_mean(params: Parameters, mean: dict[str, Any]) -> None:
    """Set the parameters to their means, if there are any for these Gaussians."""
    if mean and len(mean["means"]) == len(params["means"]):
        for name in mean.keys() & params.keys():
            params[name].copy_(mean[name])
