"""The numbers that a run is made of and when things happen: splatseed's own, and 3DGS's.

Notation: a *full* run has 30,000 steps, and all numbers of 3DGS are stated for it; T are the steps of
the run at hand. Lengths, and so the rates of positions, are in *yardsticks*: a Gaussian's near depth
(``near_depths``) in splatseed's conventions, the cameras' extent in 3DGS's. Promise: a full run of
splatseed's differs from 3DGS's by the yardstick alone (and MCMC's start); each departure in short runs
was chosen on held-out training views and is listed in benchmarks/README.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

__all__ = ["FULL_RUN", "LEARNING_RATES", "Densification", "Schedule", "make_schedule"]

Densification = Literal["default", "mcmc", "none"]

FULL_RUN = 30_000
LEARNING_RATES: Mapping[str, float] = MappingProxyType(
    {
        "means": 1.6e-4,  # times the yardstick
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
)
"""3DGS's."""
MEANS_LR_DECAY = 0.01
"""The learning rate of positions at the end, as a part of that at the start; exponential between."""
LEAST_ROUNDS = 6
"""A short run densifies so many times, if need be more often than every 100 steps."""
MOST_HASTE = 20.0
"""Positions move so many times faster at most: beyond it nothing was gained."""


@dataclass(frozen=True)
class Schedule:
    """A run's numbers.

    Args:
        max_steps: T.
        near_depths: Whether each Gaussian's near depth is its yardstick, else the cameras' extent.
        learning_rates: Of each parameter at the first step; positions' in yardsticks.
        sh_every: Steps from one degree of the spherical harmonics to the next.
        refine_start: Densification begins after this step.
        refine_stop: And ends before this one.
        refine_every: Steps from one densification to the next.
        reset_every: From one reset of the opacities to the next, where they are asked for; also the
            step from which on Gaussians that are too large are pruned.
        opacity: Of the first Gaussians.
        scale_factor: Size of the first Gaussians, as a multiple of the gaps between them.
    """

    max_steps: int
    near_depths: bool
    learning_rates: Mapping[str, float]
    sh_every: int
    refine_start: int
    refine_stop: int
    refine_every: int
    reset_every: int
    opacity: float = 0.1
    scale_factor: float = 1.0

    def sh_degree(self, step: int, highest: int) -> int:
        """The degree of spherical harmonics in use."""
        return min(step // self.sh_every, highest)

    def means_lr(self, step: int) -> float:
        """The learning rate of positions, in yardsticks."""
        return float(self.learning_rates["means"] * self.decay(step))

    def decay(self, step: int) -> float:
        """What the learning rate of positions has fallen to, as a part of the first."""
        return float(MEANS_LR_DECAY ** (step / self.max_steps))


def make_schedule(densification: Densification, max_steps: int, *, as_3dgs: bool) -> Schedule:
    """The schedule of a run.

    Args:
        densification: How Gaussians are added and removed.
        max_steps: T.
        as_3dgs: Whether in 3DGS's conventions, as gsplat's trainer has them with its
            ``steps_scaler``: every step number shrinks with T, no other number does.
    """
    return (_as_3dgs if as_3dgs else _own)(densification, max_steps)


def _as_3dgs(densification: Densification, max_steps: int) -> Schedule:
    mcmc = densification == "mcmc"
    return Schedule(
        max_steps=max_steps,
        near_depths=False,
        learning_rates=LEARNING_RATES,
        sh_every=_scaled(1000, max_steps),
        refine_start=_scaled(500, max_steps),
        refine_stop=_scaled(25_000 if mcmc else 15_000, max_steps),
        refine_every=_scaled(100, max_steps),
        reset_every=_scaled(3000, max_steps),
        opacity=0.5 if mcmc else 0.1,
        scale_factor=0.1 if mcmc else 1.0,
    )
