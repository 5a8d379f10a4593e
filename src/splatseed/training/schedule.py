"""The hyperparameters of a run and their timing: splatseed's own, and 3DGS's.

Notation: a *full* run has 30,000 steps, for which all of 3DGS's numbers are stated; T is the number
of steps of the run. Lengths, and so the rates of positions, are in *size units*: a Gaussian's min
view depth (``initialization``) in splatseed's conventions, the cameras' extent in 3DGS's. Promise:
a full run of splatseed's differs from 3DGS's in the size unit, in bounds on sizes (initial sizes
have one, later sizes have none), and in MCMC's start; these and each departure in short runs were
chosen on held-out training views: see benchmarks/tried.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from splatseed.training.traits import StrategyTraits

FULL_RUN = 30_000

FEW_STEPS, MAX_SHORT = 1_500, 11
"""Default steps of ``train``, and with how many training photographs at most: more fit these
better, but not other views."""

LEARNING_RATES: Mapping[str, float] = MappingProxyType(
    {
        "means": 1.6e-4,  # times the size unit
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
)
"""3DGS's."""
DECAYS: Mapping[str, float] = MappingProxyType({"means": 0.01})
"""Final learning rates as a fraction of the initial ones; exponential in between."""
MCMC_GROWTH = 1.05
"""Factor by which MCMC grows the number of Gaussians at a time, up to the cap."""
MAX_SPEEDUP: Mapping[str, float] = MappingProxyType(
    {"means": 20.0, "scales": 4.0, "quats": 4.0, "opacities": 1.0, "sh0": 4.0, "shN": 16.0}
)
"""A run n times shorter than a full run multiplies its learning rates by n, but at most by these.
Positions have as far to go in a short run as in a long one, and 3DGS's rate of higher harmonics is
a twentieth of the colour's; a higher rate of opacities removes Gaussians that are needed later."""
FORGETTING = 1e-3
"""1 - beta2 of Adam, the fraction of the squared gradients forgotten per step, as in 3DGS."""
MAX_FORGETTING = 1e-2
"""A run n times shorter forgets n times faster, but at most this fraction per step: gradients
shrink within some hundred steps, and Adam divides steps by the remembered gradients."""
MIN_ROUND_STEPS = 20
"""Minimum steps between densifications where ``StrategyTraits.round_steps`` is set: halves that are
split again before they have settled are noise."""
MEAN_FROM = 0.8
"""Fraction of a run after which the mean of the Gaussians is taken."""
MAX_FEW_VIEWS = 16
"""Maximum number of training photographs that count as few: they are fitted by Gaussians that no
other view confirms. With more photographs, close to each other, dropout loses."""
DROPOUT, DROPOUT_RANGE = 10.0, (0.2, 0.8)
"""With n <= ``MAX_FEW_VIEWS`` training photographs the last step drops ``DROPOUT`` / n^2 of the
Gaussians, within the range; earlier steps drop fewer, linear from 0 at the first. Source:
DropGaussian (H. Park et al., 2025)."""
OPACITY_DECAY, MAX_DECAY = 0.036, 0.002
"""With these each step lowers all opacities by the fraction ``OPACITY_DECAY`` / n^2, or
``MAX_DECAY``, so that Gaussians that few pixels need vanish. Source: L. Han et al.,
Binocular-Guided 3D Gaussian Splatting with View Consistency for Sparse View Synthesis (2024)."""
MAX_SIZE = 0.05
"""Maximum initial size of a Gaussian, in min view depths. Where SfM has few points the gaps between
them are wide, and a Gaussian that fills a gap hides everything behind it."""


@dataclass(frozen=True)
class Schedule:
    """The hyperparameters of a run."""

    max_steps: int  # T
    depth_units: bool  # size units are min view depths, not the cameras' extent
    learning_rates: Mapping[str, float]  # initial ones; for positions in size units
    decays: Mapping[str, float]  # final fraction of those rates that decay
    beta2: float  # Adam's: the fraction of the mean squared gradient kept at each step
    sh_every: int  # steps between degrees of the spherical harmonics; 0: all at once
    refine_start: int
    """Step at which densification starts. It follows each step, counted from 0, that is a multiple
    of ``refine_every`` between ``refine_start`` and ``refine_stop``; ``grow`` includes these two
    steps, gsplat's classes (``default``, ``mcmc``) do not."""
    refine_stop: int  # step at which densification ends
    refine_every: int  # steps between densifications
    reset_every: int
    """Steps between resets of the opacities, if enabled; also the step after which Gaussians that
    are too large are pruned."""
    prune_size: float = 0.1
    """Scale above which Gaussians are pruned, in size units; infinite in splatseed's conventions:
    large Gaussians show a bare wall or the sky best, and pruning them cost 2.8 dB in a room."""
    growth: float = MCMC_GROWTH  # factor by which MCMC grows the number of Gaussians at a time
    noise: float = 5e5  # factor on 3DGS's learning rate of positions, for MCMC's noise
    penalty: float = 0.01  # weight of mean opacity and of mean size in MCMC's loss
    opacity: float = 0.1  # initial one
    scale_factor: float = 1.0  # initial size, as a multiple of the gap between Gaussians
    max_size: float = math.inf  # upper bound of the initial size, in min view depths
    flatness: float = 0.1  # initial thickness of Gaussians with normals, relative to their size
    recycles: bool = True  # strategy grow replaces Gaussians where seeds fill the budget
    regularizes_few: bool = False  # dropout and opacity decay, if views are few
    random_background: bool = False
    """Each step has another background: over black, dark pixels are left transparent, and other
    views show something else through them."""
    mean_from: int | None = None
    """Step from which on the Gaussians are averaged to the run's result; None: the last step's are
    the result."""

    def sh_degree(self, step: int, highest: int) -> int:
        """Return the degree of the spherical harmonics at a step."""
        return min(step // self.sh_every, highest) if self.sh_every else highest

    def dropout_at(self, step: int, num_views: int) -> float:
        """Return the fraction of the Gaussians that a step of a run on these many views drops."""
        if not self._has_few(num_views):
            return 0.0
        least, most = DROPOUT_RANGE
        return max(least, min(DROPOUT / num_views**2, most)) * step / self.max_steps

    def opacity_decay(self, num_views: int) -> float:
        """Return the fraction that opacities lose in each step of a run on these many views."""
        return min(OPACITY_DECAY / num_views**2, MAX_DECAY) if self._has_few(num_views) else 0.0

    def _has_few(self, num_views: int) -> bool:
        return self.regularizes_few and num_views <= MAX_FEW_VIEWS

    def rates(self, step: int) -> dict[str, float]:
        """Return the learning rate of each parameter; of positions in size units."""
        return {name: rate * self.decay(name, step) for name, rate in self.learning_rates.items()}

    def decay(self, name: str, step: int) -> float:
        """Return the fraction of the initial learning rate at a step."""
        return float(self.decays.get(name, 1.0) ** (step / self.max_steps))


def default_steps(num_views: int) -> int:
    """Return the default steps of ``train`` on these many photographs."""
    return FEW_STEPS if 0 < num_views <= MAX_SHORT else FULL_RUN


def make_schedule(strategy: StrategyTraits, max_steps: int, *, as_3dgs: bool) -> Schedule:
    """Return the schedule of a run of T steps with a strategy.

    3DGS's conventions are those of gsplat's trainer with its ``steps_scaler``: step numbers are
    proportional to T, other numbers are not.
    """
    schedule = Schedule(
        max_steps=max_steps,
        depth_units=False,
        learning_rates=LEARNING_RATES,
        decays=DECAYS,
        beta2=1 - FORGETTING,
        sh_every=_scaled(1000, max_steps),
        refine_start=_scaled(500, max_steps),
        refine_stop=_scaled(strategy.refine_stop, max_steps),
        refine_every=_scaled(100, max_steps),
        reset_every=_scaled(3000, max_steps),
        opacity=strategy.first_opacity,
        scale_factor=strategy.first_size,
    )
    return schedule if as_3dgs else _own(schedule, strategy)


def continued(schedule: Schedule) -> Schedule:
    """Return the schedule of a run that continues from Gaussians: all harmonics at once.

    It keeps the rates of a new run: lower rates lose (benchmarks/tried.md).
    """
    return replace(schedule, sh_every=0, recycles=False)


def _own(theirs: Schedule, strategy: StrategyTraits) -> Schedule:
    """Return splatseed's schedule: its departures from 3DGS's."""
    speedup, stop = max(FULL_RUN / theirs.max_steps, 1.0), theirs.refine_stop
    # 3DGS densifies every 100 steps of 30,000.
    shrunk, start = 100 * theirs.max_steps / FULL_RUN, theirs.refine_start
    every = max(1, round(shrunk), min(100, stop // strategy.min_rounds))
    if strategy.round_steps is not None:
        every = start = max(MIN_ROUND_STEPS, _scaled(strategy.round_steps, theirs.max_steps))
    rates = {n: rate * min(speedup, MAX_SPEEDUP[n]) for n, rate in LEARNING_RATES.items()}
    return replace(
        theirs,
        depth_units=True,
        learning_rates=rates,
        # 0.999 in a full run, 0.99 from a tenth of it down.
        beta2=1 - min(FORGETTING * speedup, MAX_FORGETTING),
        refine_start=start,
        refine_every=every,
        prune_size=math.inf,
        # Fewer rounds than 3DGS has grow by more each, so that the cap is reached as early.
        growth=MCMC_GROWTH ** (every / shrunk),
        scale_factor=1.0,
        max_size=MAX_SIZE,
        regularizes_few=True,
        random_background=True,
        # Only once the number of Gaussians no longer changes.
        mean_from=max(stop, round(MEAN_FROM * theirs.max_steps)),
    )


def _scaled(steps: int, max_steps: int) -> int:
    """Return the steps of this run that correspond to ``steps`` of a full run, at least 1."""
    return max(1, round(steps * max_steps / FULL_RUN))
