"""Strategy ``default``: 3DGS's densification, as gsplat implements it, within a capacity.

gsplat 1.5.3 never resets opacities (its ``step % reset_every == 0 & step > 0`` is always false):
resetting is an option here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa
from torch import Tensor

from splatseed.splat.training_frame import SCENE_SCALE
from splatseed.training.device import Capacity, on_one_thread
from splatseed.training.parameters import MIN_VIEW_DEPTH, Optimizers, Parameters, size_unit
from splatseed.training.settings import TrainSettings
from splatseed.training.strategies.base import Strategy


class Capped(DefaultStrategy):  # type: ignore[misc]  # gsplat has no types
    """gsplat's strategy within a capacity: the largest gradients grow first.

    Running sums equal gsplat's up to rounding. gsplat lists the visible Gaussians, which
    synchronises with a GPU, and reduces rows of two, which is slow on the CPU.
    """

    capacity: Capacity
    grow_grad2d: float

    def _update_state(self, params: Parameters, state: Any, info: Any, packed: bool) -> None:
        assert not packed  # noqa: S101  (``info`` lists all Gaussians)
        means = params["means"]
        for name in ("grad2d", "count"):
            if state[name] is None:
                state[name] = torch.zeros(len(means), device=means.device)
        radii, half_cameras = info["radii"], info["n_cameras"] / 2.0
        seen = (radii[..., 0] > 0) & (radii[..., 1] > 0)
        x, y = info["means2d"].grad.unbind(-1)
        # gsplat's units: gradients by normalised image coordinates, -1 to 1, whatever the size.
        x, y = x * (info["width"] * half_cameras), y * (info["height"] * half_cameras)
        for camera, lengths in enumerate(torch.hypot(x, y)):
            state["grad2d"] += lengths
            state["count"] += seen[camera]

    def _grow_gs(self, params: Parameters, optimizers: Any, state: Any, step: int) -> Any:
        wanted = self.grow_grad2d
        self.grow_grad2d = self._threshold(params, state)
        try:
            return super()._grow_gs(params, optimizers, state, step)
        finally:
            self.grow_grad2d = wanted

    def _threshold(self, params: Parameters, state: Any) -> float:
        """Return the gradient that at most as many Gaussians exceed as there is room for."""
        count, gradients = len(params["means"]), state["grad2d"] / state["count"].clamp_min(1)
        wanted = int((gradients > self.grow_grad2d).sum())
        room = self.capacity.limit(count, count + wanted) - count
        if room <= 0:
            return math.inf
        if room >= wanted:
            return self.grow_grad2d
        # The (room + 1)-th largest: exactly ``room`` exceed it.
        return max(self.grow_grad2d, float(torch.topk(gradients, room + 1).values[-1]))


class Default(Strategy):
    """3DGS's densification: clone and split by the image gradient, prune the transparent."""

    def __init__(self, settings: TrainSettings, capacity: Capacity) -> None:
        super().__init__(capacity)
        schedule = settings.schedule
        self.inner = Capped(
            refine_start_iter=schedule.refine_start,
            refine_stop_iter=schedule.refine_stop,
            refine_every=schedule.refine_every,
            reset_every=schedule.reset_every,
            prune_scale3d=schedule.prune_size,
        )
        self.inner.capacity = capacity
        self.resets = settings.opacity_reset
        self.state = self.inner.initialize_state()

    @classmethod
    def of(
        cls,
        settings: TrainSettings,
        capacity: Capacity,
        depths: Mapping[str, Tensor],  # noqa: ARG003  (the interface's name)
        share: float,  # noqa: ARG003
    ) -> Self:
        """Make the strategy of a run; depths are not used."""
        return cls(settings, capacity)

    def before_backward(
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any
    ) -> None:
        """Retain the gradient of the image positions."""
        self.inner.step_pre_backward(params, optimizers, self.state, step, info)

    def after_step(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Clone, split, prune, and reset opacities if enabled."""
        # gsplat takes one number here, or one per Gaussian like the rest of its state.
        self.state["scene_scale"] = size_unit(params) if MIN_VIEW_DEPTH in params else SCENE_SCALE
        with on_one_thread(params["means"].device):
            self.inner.step_post_backward(params, optimizers, self.state, step, info)
        refines = self.resets and 0 < step < self.inner.refine_stop_iter
        if refines and step % self.inner.reset_every == 0:
            # Twice the opacity at which Gaussians are pruned: optimisation raises the needed ones.
            reset_opa(params, optimizers, self.state, value=2 * self.inner.prune_opa)
