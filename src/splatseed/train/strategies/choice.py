"""The strategy that settings name."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.train.device import Capacity
from splatseed.train.settings import TrainSettings
from splatseed.train.strategies.base import Strategy
from splatseed.train.strategies.densification import Default, Fixed, Mcmc
from splatseed.train.strategies.growing import NOWHERE, Growing


def make_strategy(
    settings: TrainSettings,
    device: torch.device | None = None,
    depths: Mapping[str, Float[Tensor, "h w"]] = NOWHERE,
) -> Strategy:
    """The strategy named by the settings, on their schedule.

    Args:
        settings: How to train.
        device: The device whose memory limits the number of Gaussians; the CPU by default.
        depths: Known depths of the training views; see ``Growing``.
    """
    capacity = Capacity(settings.cap, device or torch.device("cpu"))
    match settings.densification:
        case "default":
            return Default(settings, capacity)
        case "mcmc":
            return Mcmc(settings, capacity)
        case "grow":
            return Growing(settings, capacity, depths)
        case "none":
            return Fixed()
