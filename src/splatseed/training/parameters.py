"""The trained parameters in PyTorch, their optimisers, and their mean over the end of a run.

Notation: gsplat's parameter dict: ``means``, ``scales`` (logarithms), ``quats``, ``opacities``
(logits), ``sh0``, ``shN``; one Adam each, as gsplat's strategies need them. In splatseed's
conventions the dict also has ``min_view_depth`` [N], which is constant: operations that add, move
or remove Gaussians treat it like the other parameters. Steps on single photographs keep the
parameters oscillating; their mean does not oscillate (Polyak and Juditsky, 1992).
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseed.splat.gaussians import PARAMETERS, Gaussians
from splatseed.splat.rendering import opacity_from_logits
from splatseed.splat.training_frame import SCENE_SCALE
from splatseed.training.schedule import Schedule

Parameters = torch.nn.ParameterDict
Optimizers = dict[str, torch.optim.Optimizer]

ADAM_BETA1 = 0.9
"""Decay of Adam's mean gradient, PyTorch's default."""
ADAM_EPSILON = 1e-15
"""3DGS's: far below any gradient, so that rarely seen Gaussians take full steps too."""
MIN_VIEW_DEPTH = "min_view_depth"
DROPPED, MAX_RAISED = -20.0, 0.995
"""The logit of a dropped Gaussian, which no pixel shows and none decays below, and the highest
opacity of another."""
MAX_LOGIT = 15.0
"""Largest logit of an opacity that is split: from 17 on its sigmoid is 1 in float32, and the
logits of the halves infinite."""


def make_parameters(
    gaussians: Gaussians,
    device: torch.device,
    min_view_depths: Float32[np.ndarray, " N"] | None = None,
) -> Parameters:
    """Copy the Gaussians' arrays to a device as trainable parameters.

    Without ``min_view_depths`` the cameras' extent is the size unit of all.
    """
    arrays = gaussians.arrays()
    if min_view_depths is not None:
        arrays[MIN_VIEW_DEPTH] = min_view_depths
    return as_parameters({name: torch.tensor(each, device=device) for name, each in arrays.items()})


def as_parameters(tensors: Mapping[str, Tensor]) -> Parameters:
    """Return the parameter dict of these tensors; all but the min view depth are learnt."""
    return Parameters(
        {
            name: torch.nn.Parameter(value, requires_grad=name != MIN_VIEW_DEPTH)
            for name, value in tensors.items()
        }
    )


def gaussians_of(params: Parameters | Mapping[str, Tensor]) -> Gaussians:
    """Return the parameters as NumPy arrays (sharing memory on the CPU)."""
    arrays: dict[str, Any] = {name: params[name].detach().cpu().numpy() for name in PARAMETERS}
    return Gaussians(**arrays)


def size_unit(params: Parameters) -> Float[Tensor, "#N"]:
    """Return the unit of each Gaussian's size and learning rate, [N], or [1] if all share it."""
    if MIN_VIEW_DEPTH in params:
        unit: Tensor = params[MIN_VIEW_DEPTH].detach()
    else:
        unit = params["means"].new_full((1,), SCENE_SCALE)
    return unit


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
    """Make one Adam per parameter, with the schedule's learning rates."""
    betas = ADAM_BETA1, schedule.beta2
    return {
        name: _Adam([value], schedule.learning_rates[name], betas, ADAM_EPSILON, fused=True)
        for name, value in params.items()
        if value.requires_grad
    }


def optimize(params: Parameters, optimizers: Optimizers, rates: Mapping[str, float]) -> None:
    """Take an optimiser step at these rates, for positions in size units, and clear gradients."""
    means, unit = params["means"], size_unit(params)
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
        positions[:, axis].addcmul_(means.data[:, axis], unit)
    means.data = positions


def with_dropout(params: Parameters, fraction: float) -> Parameters | Mapping[str, Tensor]:
    """Drop a random ``fraction`` of the Gaussians, by PyTorch's generator.

    The other opacities are multiplied by 1 / (1 - fraction), which keeps their mean; only they
    receive gradients (H. Park et al., "DropGaussian", 2025).
    """
    if fraction <= 0:
        return params
    opacities = opacity_from_logits(params["opacities"])
    kept = torch.rand_like(opacities) >= fraction
    raised = torch.logit((opacities / (1 - fraction)).clamp(max=MAX_RAISED))
    return {**params, "opacities": torch.where(kept, raised, DROPPED)}


@torch.no_grad()
def decay_opacities(params: Parameters, fraction: float) -> None:
    """Take a ``fraction`` from all opacities."""
    if fraction > 0:
        # o' = f o with o = 1 / (1 + exp(-x)), so exp(-x') = (1 + exp(-x)) / f - 1.
        logits = params["opacities"].neg_().exp_().add_(1.0).div_(1.0 - fraction).sub_(1.0)
        logits.log_().neg_().clamp_(min=DROPPED)


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
