"""How Gaussians are added and removed: gsplat's strategies behind one small interface.

Notation: ``info`` is the rasteriser's; ``before`` runs ahead of the backward pass, ``after`` behind
the optimisers. Promise: gsplat's strategies run as they are, on both backends; ``state`` is all that
a checkpoint must hold of them. gsplat 1.5.3 never resets opacities (it writes
``step % reset_every == 0 & step > 0``, which is always false), so that is an option here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from jaxtyping import Float
from torch import Tensor

from splatseed.render import MCMCStrategy
from splatseed.train.device import Capacity
from splatseed.train.frame import SCENE_SCALE
from splatseed.train.parameters import Optimizers, Parameters
from splatseed.train.settings import MCMC_CAP, TrainSettings

__all__ = ["Strategy", "make_strategy"]

GROWTH = 1.05
"""By what MCMC multiplies the number of Gaussians at a time, until the cap."""


class Strategy(ABC):
    """What changes the number of Gaussians, and how they begin.

    Attributes:
        state: What it remembers from step to step.
        capacity: How many Gaussians it may make; None if it makes none.
    """

    opacity: ClassVar[float] = 0.1
    """Of the first Gaussians."""
    scale_factor: ClassVar[float] = 1.0
    """Size of the first Gaussians, as a multiple of the gaps between them."""

    def __init__(self, capacity: Capacity | None = None) -> None:
        self.state: dict[str, Any] = {}
        self.capacity = capacity

    def regularization(self, params: Parameters) -> Float[Tensor, ""] | None:  # noqa: ARG002
        """What is added to the loss; nothing by default."""
        return None

    @abstractmethod
    def before(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """To be called ahead of the backward pass."""

    @abstractmethod
    def after(
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any, means_lr: float
    ) -> None:
        """To be called behind the optimisers; may replace parameters and their moments."""


def make_strategy(settings: TrainSettings, device: torch.device | None = None) -> Strategy:
    """The strategy that the settings name, on their schedule.

    Args:
        settings: How to train.
        device: Whose memory bounds the number of Gaussians; the CPU's by default.
    """
    device = device or torch.device("cpu")
    if settings.strategy == "default":
        return _Default(settings, Capacity(settings.cap, device))
    if settings.strategy == "mcmc":
        return _Mcmc(settings, Capacity(settings.cap or MCMC_CAP, device))
    return _Fixed()


class _Fixed(Strategy):
    """The seeds as they are: neither more nor fewer."""

    def before(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        pass

    def after(
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any, means_lr: float
    ) -> None:
        pass


class _Capped(DefaultStrategy):  # type: ignore[misc]  # gsplat has no types
    """gsplat's strategy, but that only the largest image gradients that there is room for grow.

    On the CPU its running sums are kept in another way, to the same bytes.
    """

    capacity: Capacity
    grow_grad2d: float

    def _update_state(
        self, params: Parameters, state: Any, info: Any, packed: bool = False
    ) -> None:
        if packed or params["means"].device.type != "cpu":
            super()._update_state(params, state, info, packed)
            return
        for name in ("grad2d", "count"):
            if state[name] is None:
                state[name] = torch.zeros(len(params["means"]))
        _add_gradients(state, info)

    def _grow_gs(self, params: Parameters, optimizers: Any, state: Any, step: int) -> Any:
        wanted = self.grow_grad2d
        self.grow_grad2d = self._threshold(params, state)
        try:
            return super()._grow_gs(params, optimizers, state, step)
        finally:
            self.grow_grad2d = wanted

    def _threshold(self, params: Parameters, state: Any) -> float:
        """A gradient that at most as many exceed as there is room: each one adds one Gaussian."""
        count, gradients = len(params["means"]), state["grad2d"] / state["count"].clamp_min(1)
        wanted = int((gradients > self.grow_grad2d).sum())
        room = self.capacity.limit(count, count + wanted) - count
        if room <= 0:
            return math.inf
        if room >= wanted:
            return self.grow_grad2d
        return max(self.grow_grad2d, float(torch.topk(gradients, room + 1).values[-1]))


def _add_gradients(state: Any, info: Any) -> None:
    """Count each Gaussian that is seen, and add up the lengths of the gradients of its 2D mean.

    gsplat lists the Gaussians that are seen and gathers their gradients, which takes three times as
    long as adding zeros for the others.
    """
    radii, half_cameras = info["radii"], info["n_cameras"] / 2.0
    seen = (radii[..., 0] > 0) & (radii[..., 1] > 0)
    halves = torch.tensor([info["width"] * half_cameras, info["height"] * half_cameras])
    lengths = (info["means2d"].grad * halves).norm(dim=-1)
    for camera in range(info["n_cameras"]):
        state["grad2d"] += lengths[camera]
        state["count"] += seen[camera]


class _Default(Strategy):
    """3DGS's densification: clone and split where the image gradient is large, prune the faint."""

    def __init__(self, settings: TrainSettings, capacity: Capacity) -> None:
        super().__init__(capacity)
        schedule = settings.schedule
        self.inner = _Capped(
            refine_start_iter=schedule.refine_start,
            refine_stop_iter=schedule.refine_stop("default"),
            refine_every=schedule.refine_every("default"),
            reset_every=schedule.reset_every,
        )
        self.inner.capacity = capacity
        self.resets = settings.opacity_reset
        self.state = self.inner.initialize_state(scene_scale=SCENE_SCALE)

    def before(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        self.inner.step_pre_backward(params, optimizers, self.state, step, info)

    def after(
        self,
        params: Parameters,
        optimizers: Optimizers,
        step: int,
        info: Any,
        means_lr: float,  # noqa: ARG002  (MCMC's)
    ) -> None:
        self.inner.step_post_backward(params, optimizers, self.state, step, info)
        if self._resets_at(step):
            reset_opa(params, optimizers, self.state, value=2 * self.inner.prune_opa)

    def _resets_at(self, step: int) -> bool:
        while_refining = self.resets and 0 < step < self.inner.refine_stop_iter
        return while_refining and step % self.inner.reset_every == 0


@dataclass
class _Bounded(MCMCStrategy):
    """gsplat's strategy, but that its cap is never more than fits the memory."""

    capacity: Capacity | None = None

    def _add_new_gs(self, params: Parameters, optimizers: Any, binoms: Any) -> int:
        assert self.capacity is not None  # noqa: S101  (given in ``_Mcmc``)
        count = len(params["means"])
        self.cap_max = self.capacity.limit(count, int(GROWTH * count))
        return int(super()._add_new_gs(params, optimizers, binoms))


class _Mcmc(Strategy):
    """3DGS as MCMC: move the faint to where there is more to show, add up to a cap, add noise."""

    opacity = 0.5
    scale_factor = 0.1
    OPACITY_WEIGHT = 0.01
    SCALE_WEIGHT = 0.01

    def __init__(self, settings: TrainSettings, capacity: Capacity) -> None:
        super().__init__(capacity)
        schedule = settings.schedule
        self.inner = _Bounded(
            capacity=capacity,
            refine_start_iter=schedule.refine_start,
            refine_stop_iter=schedule.refine_stop("mcmc"),
            refine_every=schedule.refine_every("mcmc"),
        )
        self.state = self.inner.initialize_state()

    def regularization(self, params: Parameters) -> Float[Tensor, ""]:
        opacity = torch.sigmoid(params["opacities"]).mean()
        return (
            self.OPACITY_WEIGHT * opacity + self.SCALE_WEIGHT * torch.exp(params["scales"]).mean()
        )

    def before(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        pass

    def after(
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any, means_lr: float
    ) -> None:
        self.inner.step_post_backward(params, optimizers, self.state, step, info, lr=means_lr)
