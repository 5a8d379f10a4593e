"""The interface of strategies, and gsplat's behind it; splatseed's own is in ``growing``.

Promise: both backends run subclasses of gsplat's strategies, which hold growth to a cap and to the
memory, and MCMC's growth and noise to splatseed's conventions; ``state`` is all that a checkpoint
must hold. gsplat 1.5.3 never resets opacities (its ``step % reset_every == 0 & step > 0`` is always
false): resetting is an option here.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import reset_opa, sample_add
from jaxtyping import Float
from torch import Tensor

from splatseed.photos.view import View
from splatseed.rendering import MCMCStrategy
from splatseed.splat.gaussians import SCENE_SCALE
from splatseed.splat.rendering import opacities_of
from splatseed.training.device import Capacity, on_one_thread
from splatseed.training.parameters import NEAR_DEPTHS, Optimizers, Parameters, length_units
from splatseed.training.schedule import LEARNING_RATES, Schedule
from splatseed.training.settings import TrainSettings


class Strategy:
    """Changes the number of Gaussians, within a capacity; this one, ``none``, does not."""

    def __init__(self, capacity: Capacity) -> None:
        self.state: dict[str, Any] = {}  # what it remembers from step to step
        self.capacity = capacity

    def regularization(self, params: Parameters) -> Float[Tensor, ""] | None:  # noqa: ARG002  (the interface's name)
        """A term to add to the loss."""
        return None

    def before(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Called before the backward pass."""

    def observe(
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """Called after the optimisers, with the result of the step."""

    def after(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Called after ``observe``; may replace parameters and their moments."""


class Capped(DefaultStrategy):  # type: ignore[misc]  # gsplat has no types
    """gsplat's strategy, but only as many Gaussians grow as there is room, largest gradients first.

    Its running sums are computed differently, equal up to rounding: gsplat lists the visible
    Gaussians, for which a GPU is waited for, and reduces rows of two, which is slow on the CPU.
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
        """A gradient that at most as many Gaussians exceed as there is room: each adds one."""
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
    """3DGS's densification: clone and split where the image gradient is large, prune the faint."""

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

    def before(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Keep the image gradients."""
        self.inner.step_pre_backward(params, optimizers, self.state, step, info)

    def after(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Clone, split, prune, and reset opacities if enabled."""
        # gsplat takes one number here, or one per Gaussian like the rest of its state.
        self.state["scene_scale"] = length_units(params) if NEAR_DEPTHS in params else SCENE_SCALE
        with on_one_thread(params["means"].device):
            self.inner.step_post_backward(params, optimizers, self.state, step, info)
        while_refining = self.resets and 0 < step < self.inner.refine_stop_iter
        if while_refining and step % self.inner.reset_every == 0:
            # Twice the opacity at which Gaussians are pruned: those that matter recover, others go.
            reset_opa(params, optimizers, self.state, value=2 * self.inner.prune_opa)


class _Bounded(MCMCStrategy):
    """gsplat's strategy, but it may grow faster, and never beyond the memory.

    gsplat moves positions by a covariance, an area, times noise. Here that is divided by the near
    depth, so that noise looks the same in the photographs wherever a Gaussian is.
    """

    capacity: Capacity
    schedule: Schedule

    def set_noise(self, params: Parameters) -> None:
        """Called before each step, and whenever the number of Gaussians changes."""
        if NEAR_DEPTHS in params:
            # gsplat: noise = covariance x normal x lr x noise_lr
            self.noise_lr = self.schedule.noise / length_units(params)[:, None]

    def _add_new_gs(self, params: Parameters, optimizers: Any, binoms: Any) -> int:
        count = len(params["means"])
        # Gaussians grow by 5% a round, by more where rounds are fewer; up to the cap.
        added = max(0, self.capacity.limit(count, int(self.schedule.growth * count)) - count)
        if added:
            sample_add(params, optimizers, {}, added, binoms, self.min_opacity)
        self.set_noise(params)
        return added


class Mcmc(Strategy):
    """3DGS as MCMC: relocate the faint to where more is needed, grow up to a cap, add noise."""

    def __init__(self, settings: TrainSettings, capacity: Capacity) -> None:
        super().__init__(capacity)
        self.schedule = schedule = settings.schedule
        self.inner = _Bounded(
            # 5e5 times the rate of positions: faint Gaussians wander, opaque ones stay.
            noise_lr=schedule.noise,
            refine_start_iter=schedule.refine_start,
            refine_stop_iter=schedule.refine_stop,
            refine_every=schedule.refine_every,
        )
        self.inner.capacity, self.inner.schedule = capacity, schedule
        self.state = self.inner.initialize_state()

    def regularization(self, params: Parameters) -> Float[Tensor, ""]:
        """Mean opacity and mean size, weighted."""
        opacities, sizes = opacities_of(params["opacities"]), torch.exp(params["scales"])
        if NEAR_DEPTHS in params:
            sizes = sizes / length_units(params)[:, None]
        # 0.01 (mean opacity + mean size): needless Gaussians fade, and are relocated.
        return self.schedule.penalty * (opacities.mean() + sizes.mean())

    def after(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Relocate, add, and perturb."""
        self.inner.set_noise(params)
        # 3DGS's rate of positions, however fast they move here: the noise must not grow with it.
        lr = LEARNING_RATES["means"] * self.schedule.decay("means", step)
        unit = 1.0 if NEAR_DEPTHS in params else SCENE_SCALE
        with on_one_thread(params["means"].device):
            self.inner.step_post_backward(params, optimizers, self.state, step, info, lr=lr * unit)
