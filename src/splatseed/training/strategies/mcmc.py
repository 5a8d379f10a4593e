"""Strategy ``mcmc``: gsplat's, within a capacity, with size units that follow the view depth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import torch
from gsplat.strategy.ops import sample_add
from jaxtyping import Float
from torch import Tensor

from splatseed.rendering import MCMCStrategy
from splatseed.splat.rendering import opacity_from_logits
from splatseed.splat.training_frame import SCENE_SCALE
from splatseed.training.device import Capacity, on_one_thread
from splatseed.training.parameters import MIN_VIEW_DEPTH, Optimizers, Parameters, size_unit
from splatseed.training.schedule import LEARNING_RATES, Schedule
from splatseed.training.settings import TrainSettings
from splatseed.training.strategies.base import Strategy


class _BoundedMcmc(MCMCStrategy):
    """gsplat's strategy with faster growth in short runs, within a capacity.

    gsplat moves positions by covariance (an area) times noise. Dividing by the size unit makes the
    noise look alike in the photographs wherever a Gaussian is.
    """

    capacity: Capacity
    schedule: Schedule

    def set_noise(self, params: Parameters) -> None:
        """Set the noise; to be called before each step and when the number of Gaussians changes."""
        if MIN_VIEW_DEPTH in params:
            # gsplat: noise = covariance x normal x lr x noise_lr
            self.noise_lr = self.schedule.noise / size_unit(params)[:, None]

    def _add_new_gs(self, params: Parameters, optimizers: Any, binoms: Any) -> int:
        count = len(params["means"])
        # Gaussians grow by 5% a round, by more where rounds are fewer; up to the cap.
        added = max(0, self.capacity.limit(count, int(self.schedule.growth * count)) - count)
        if added:
            sample_add(params, optimizers, {}, added, binoms, self.min_opacity)
        self.set_noise(params)
        return added


class Mcmc(Strategy):
    """3DGS as MCMC (Kheradmand et al. 2024): relocate transparent Gaussians, grow, add noise."""

    def __init__(self, settings: TrainSettings, capacity: Capacity) -> None:
        super().__init__(capacity)
        self.schedule = schedule = settings.schedule
        self.inner = _BoundedMcmc(
            # 5e5 times the rate of positions: faint Gaussians wander, opaque ones stay.
            noise_lr=schedule.noise,
            refine_start_iter=schedule.refine_start,
            refine_stop_iter=schedule.refine_stop,
            refine_every=schedule.refine_every,
        )
        self.inner.capacity, self.inner.schedule = capacity, schedule
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

    def regularization(self, params: Parameters) -> Float[Tensor, ""]:
        """Return the weighted sum of mean opacity and mean size."""
        opacities, sizes = opacity_from_logits(params["opacities"]), torch.exp(params["scales"])
        if MIN_VIEW_DEPTH in params:
            sizes = sizes / size_unit(params)[:, None]
        # 0.01 (mean opacity + mean size): unneeded Gaussians fade, and are relocated.
        return self.schedule.penalty * (opacities.mean() + sizes.mean())

    def after_step(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Relocate, add, and perturb."""
        self.inner.set_noise(params)
        # The noise scales with 3DGS's rate of positions, not with the rate of a short run.
        lr = LEARNING_RATES["means"] * self.schedule.decay("means", step)
        unit = 1.0 if MIN_VIEW_DEPTH in params else SCENE_SCALE
        with on_one_thread(params["means"].device):
            self.inner.step_post_backward(params, optimizers, self.state, step, info, lr=lr * unit)
