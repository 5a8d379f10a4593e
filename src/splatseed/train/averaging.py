"""The mean of the Gaussians over the end of a run, which is what the run ends with.

Steps on one photograph each leave the parameters shaking about their best values, since only the
rate of positions falls; their mean does not shake (Polyak and Juditsky, 1992). Promise: the mean
begins anew where the number of Gaussians changes, so that each value in it is of one Gaussian.
"""

from __future__ import annotations

from typing import Any

import torch

from splatseed.train.parameters import Parameters

__all__ = ["add_to_mean", "take_mean"]

COUNT = "count"


@torch.no_grad()
def add_to_mean(mean: dict[str, Any], params: Parameters) -> None:
    """Have the mean take in the parameters as they are now.

    Args:
        mean: The means by name, and how many steps they are of; empty at first, changed in place.
        params: All that is learnt of them counts.
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
            mean[name].lerp_(value, 1.0 / mean[COUNT])
        else:
            mean[name] = value.detach().clone()


@torch.no_grad()
def take_mean(params: Parameters, mean: dict[str, Any]) -> None:
    """Set the parameters to their means, where there are any of these Gaussians."""
    if mean and len(mean["means"]) == len(params["means"]):
        for name, value in params.items():
            if name in mean:
                value.copy_(mean[name])
