"""The numbers that a run is made of and when things happen: splatseed's own, and 3DGS's.

Notation: a *full* run has 30,000 steps, and all numbers of 3DGS are stated for it; T are the steps
of the run at hand. Lengths, and so the rates of positions, are in *yardsticks*: a Gaussian's near
depth (``near_depths``) in splatseed's conventions, the cameras' extent in 3DGS's. Promise: a full
run of splatseed's differs from 3DGS's by the yardstick, the bound on first sizes and MCMC's start;
these and each departure in short runs were chosen on held-out training views: see
benchmarks/README.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

__all__ = ["FULL_RUN", "LEARNING_RATES", "Densification", "Schedule", "make_schedule"]

Densification = Literal["default", "grow", "mcmc", "none"]

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
DECAYS: Mapping[str, float] = MappingProxyType({"means": 0.01})
"""What learning rates fall to by the end, as a part of the first; exponential between."""
GROWTH = 1.05
"""By what MCMC multiplies the number of Gaussians at a time, until the cap."""
LEAST_ROUNDS: Mapping[Densification, int] = MappingProxyType(
    {"default": 6, "grow": 1, "mcmc": 24, "none": 1}
)
"""A short run densifies so many times, if need be more often than every 100 steps: gradients
averaged over few photographs are noise."""
MOST_SPEEDUP: Mapping[str, float] = MappingProxyType(
    {"means": 20.0, "scales": 4.0, "quats": 4.0, "opacities": 1.0, "sh0": 4.0, "shN": 4.0}
)
"""Learning rates of a short run are multiplied by how many times shorter it is than a full one, but
by no more than this. Positions have as far to go in a short run as in a long one; with a higher
rate of opacities, Gaussians die that are needed later."""
FORGETTING = 1e-3
"""1 - beta2 of Adam, what it forgets of the squared gradients in a step, as in 3DGS."""
MOST_FORGETTING = 1e-2
"""A short run forgets so many times faster as it is shorter than a full one, but no faster than
this: its gradients shrink within some hundred steps, and steps are divided by what is
remembered."""
GROW_EVERY = FULL_RUN // 15
"""Steps of a full run from one round of ``grow`` to the next, and to the first: each round looks at
contributions for as many photographs as it can."""
LEAST_ROUND = 20
"""Steps of a round of ``grow`` in the shortest run: halves that are split again before they have
found their places are noise."""
MEAN_FROM = 0.8
"""Part of a run from which on the mean of the Gaussians is taken."""
LARGEST = 0.05
"""Largest size of a first Gaussian, in near depths. Where SfM has few points the gaps between them
are wide, and what fills one hides all that lies behind it."""


@dataclass(frozen=True)
class Schedule:
    """A run's numbers.

    Args:
        max_steps: T.
        near_depths: Whether each Gaussian's near depth is its yardstick, else the cameras' extent.
        learning_rates: Of each parameter at the first step; positions' in yardsticks.
        decays: What some of them fall to by the end, as a part of the first.
        beta2: Adam's: what it keeps of its mean of squared gradients at each step.
        sh_every: Steps from one degree of the spherical harmonics to the next.
        refine_start: Densification begins after this step.
        refine_stop: And ends before this one.
        refine_every: Steps from one densification to the next.
        reset_every: From one reset of the opacities to the next, where they are asked for; also the
            step from which on Gaussians that are too large are pruned.
        prune_size: How large that is, in yardsticks.
        growth: What MCMC multiplies the number of Gaussians by at a time.
        noise: What it multiplies 3DGS's learning rate of positions by, for its noise.
        penalty: What it weighs mean opacity and mean size by, each, beside the loss.
        opacity: Of the first Gaussians.
        scale_factor: Size of the first Gaussians, as a multiple of the gaps between them.
        largest: And at most so many near depths.
        flatness: Thickness of the first Gaussians whose normals are used, as a part of their size.
        mean_from: After so many steps the mean of the Gaussians is taken, with which the run ends;
            None for the last step's.
    """

    max_steps: int
    near_depths: bool
    learning_rates: Mapping[str, float]
    decays: Mapping[str, float]
    beta2: float
    sh_every: int
    refine_start: int
    refine_stop: int
    refine_every: int
    reset_every: int
    prune_size: float = 0.1
    growth: float = GROWTH
    noise: float = 5e5
    penalty: float = 0.01
    opacity: float = 0.1
    scale_factor: float = 1.0
    largest: float = math.inf
    flatness: float = 0.1
    mean_from: int | None = None

    def sh_degree(self, step: int, highest: int) -> int:
        """The degree of spherical harmonics in use."""
        return min(step // self.sh_every, highest)

    def rates(self, step: int) -> dict[str, float]:
        """The learning rate of each parameter; positions' in yardsticks."""
        return {name: rate * self.decay(name, step) for name, rate in self.learning_rates.items()}

    def decay(self, name: str, step: int) -> float:
        """What a learning rate has fallen to, as a part of the first."""
        return float(self.decays.get(name, 1.0) ** (step / self.max_steps))


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
        decays=DECAYS,
        beta2=1 - FORGETTING,
        sh_every=_scaled(1000, max_steps),
        refine_start=_scaled(500, max_steps),
        refine_stop=_scaled(25_000 if mcmc else 15_000, max_steps),
        refine_every=_scaled(100, max_steps),
        reset_every=_scaled(3000, max_steps),
        opacity=0.5 if mcmc else 0.1,
        scale_factor=0.1 if mcmc else 1.0,
    )


def _own(densification: Densification, max_steps: int) -> Schedule:
    mcmc = densification == "mcmc"
    speedup = max(FULL_RUN / max_steps, 1.0)
    stop = _scaled(25_000 if mcmc else 15_000, max_steps)
    shrunk = 100 * max_steps / FULL_RUN
    every = max(1, round(shrunk), min(100, stop // LEAST_ROUNDS[densification]))
    start = _scaled(500, max_steps)
    if densification == "grow":
        every = start = max(LEAST_ROUND, _scaled(GROW_EVERY, max_steps))
    return Schedule(
        max_steps=max_steps,
        near_depths=True,
        learning_rates={
            n: rate * min(speedup, MOST_SPEEDUP[n]) for n, rate in LEARNING_RATES.items()
        },
        decays=DECAYS,
        beta2=1 - min(FORGETTING * speedup, MOST_FORGETTING),
        sh_every=_scaled(1000, max_steps),
        refine_start=start,
        refine_stop=stop,
        refine_every=every,
        reset_every=_scaled(3000, max_steps),
        growth=GROWTH ** (every / shrunk),
        opacity=0.5 if mcmc else 0.1,
        largest=LARGEST,
        mean_from=max(stop, round(MEAN_FROM * max_steps)),
    )


def _scaled(steps: int, max_steps: int) -> int:
    """What ``steps`` of a full run are in this one, at least 1."""
    return max(1, round(steps * max_steps / FULL_RUN))
