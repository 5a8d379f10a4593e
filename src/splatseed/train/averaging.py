"""The mean of the Gaussians over the last steps of a run, which becomes the result.

Steps on single photographs keep the parameters oscillating about their best values, since only the
learning rate of positions decays; the mean does not oscillate (Polyak and Juditsky, 1992). Promise:
the mean restarts when the number of Gaussians changes, so that each value averages one Gaussian.
"""

from __future__ import annotations

from typing import Any

import torch

from splatseed.train.parameters import Parameters

COUNT = "count"


@torch.no_grad()
def add_to_mean(mean: dict[str, Any], params: Parameters) -> None:
    """Add the current parameters to the mean.

    Args:
        mean: The means by name, and the number of steps; empty at first, changed in place.
        params: All learnt parameters are averaged.
    """
    count = len(params["means"])
    if not mean or len(mean["means"]) != count:
        mean.clear()
        mean[COUNT] = 0
    mean[COUNT] += 1
    for name, value in params.items():
        if not value.requires_grad:
            continue
        if name in mean:
            # m_n = m_(n-1) + (x - m_(n-1)) / n
            mean[name].lerp_(value, 1.0 / mean[COUNT])
        else:
            mean[name] = value.detach().clone()


@torch.no_grad()
def take_mean(params: Parameters, mean: dict[str, Any]) -> None:
    """Set the parameters to their means, if there are any for these Gaussians."""
    if mean and len(mean["means"]) == len(params["means"]):
        for name, value in params.items():
            if name in mean:
                value.copy_(mean[name])
