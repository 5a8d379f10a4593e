"""The settings of a run, and 3DGS's hyperparameters as gsplat's trainer has them.

Notation: a *step* shows one photograph. Promise: every schedule is stated for a run of 30 000 steps
and shrinks with ``max_steps``, so a short run does in little what a long one does at large; but
strategy ``default`` looks at as many photographs before it grows as in a long one, if it can.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from splatseed.errors import ParameterError

__all__ = [
    "LEARNING_RATES",
    "MCMC_CAP",
    "MEANS_LR_DECAY",
    "Backend",
    "Schedule",
    "StrategyName",
    "TrainSettings",
]

StrategyName = Literal["default", "mcmc", "none"]
Backend = Literal["auto", "cpu", "cuda"]

LEARNING_RATES = MappingProxyType(
    {
        "means": 1.6e-4,  # times the scene's scale
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
)
MEANS_LR_DECAY = 0.01
"""The learning rate of positions at the end, as a part of that at the start; exponential between."""
FULL_RUN = 30_000
MCMC_CAP = 1_000_000
REFINE_EVERY, MIN_REFINE_EVERY = 100, 10
LEAST_ROUNDS = 6


@dataclass(frozen=True)
class TrainSettings:
    """How to train.

    Raises:
        ParameterError: A value is out of its range.
    """

    strategy: StrategyName = "default"
    """How Gaussians are added and removed: 3DGS's densification, MCMC up to a cap, or not at all."""
    max_steps: int = FULL_RUN
    """Training steps; all schedules shrink with them."""
    data_factor: int = 1
    """By how much the photographs are made smaller, a whole number."""
    seed: int = 0
    """On the CPU the same seed gives the same bytes."""
    cap_max: int | None = None
    """Most Gaussians: more seeds are thinned out (default: 1,000,000 for mcmc, else no limit)."""
    backend: Backend = "auto"
    """Where to train; auto takes a GPU if PyTorch sees one."""
    sh_degree: int = 3
    """Degree of the spherical harmonics that colours depend on the direction by, 0 to 3."""
    test_every: int = 8
    """Of the images sorted by name, every so many-th is kept for the test."""
    opacity_reset: bool = False
    """With strategy default, lower all opacities at times as 3DGS does; gsplat 1.5.3 does not."""

    def __post_init__(self) -> None:
        for name, least in (("max_steps", 1), ("data_factor", 1), ("seed", 0), ("test_every", 2)):
            self._require(name, getattr(self, name) >= least, f"{least} or more")
        self._require("cap_max", self.cap_max is None or self.cap_max >= 2, "2 or more")
        self._require("sh_degree", 0 <= self.sh_degree <= 3, "0 to 3")

    def _require(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise ParameterError(
                f"--{name.replace('_', '-')} of {expected}",
                found=f"{getattr(self, name)}",
                fix="See splatseed train --help.",
            )

    @property
    def schedule(self) -> Schedule:
        """When things happen."""
        return Schedule(self.max_steps)

    @property
    def cap(self) -> int | None:
        """Most Gaussians; None for no limit."""
        if self.cap_max is None and self.strategy == "mcmc":
            return MCMC_CAP
        return self.cap_max


@dataclass(frozen=True)
class Schedule:
    """3DGS's schedule, shrunk to a run of ``max_steps``; all values in steps."""

    max_steps: int

    def scaled(self, steps: int) -> int:
        """What ``steps`` of a full run are in this one, at least 1."""
        return max(1, round(steps * self.max_steps / FULL_RUN))

    @property
    def refine_start(self) -> int:
        """The first densification."""
        return self.scaled(500)

    def refine_every(self, strategy: StrategyName) -> int:
        """From one densification to the next.

        ``default`` grows where gradients, averaged since the last time, are large. An average over
        few photographs is noise, and noise grows: not less than 3DGS's own 100, but where a run
        would then have fewer than ``LEAST_ROUNDS``. MCMC grows by a share each time.
        """
        scaled = max(self.scaled(REFINE_EVERY), MIN_REFINE_EVERY)
        if strategy == "mcmc":
            return scaled
        return max(scaled, min(REFINE_EVERY, self.refine_stop(strategy) // LEAST_ROUNDS))

    @property
    def reset_every(self) -> int:
        """From one reset of the opacities to the next."""
        return self.scaled(3000)

    def refine_stop(self, strategy: StrategyName) -> int:
        """The end of densification: half of the run; MCMC goes on to five sixths."""
        return self.scaled(25_000 if strategy == "mcmc" else 15_000)

    def sh_degree(self, step: int, highest: int) -> int:
        """The degree of spherical harmonics in use: one more every 1000 steps."""
        return min(step // self.scaled(1000), highest)

    def means_lr(self, step: int) -> float:
        """What the learning rate of positions is multiplied by."""
        return float(MEANS_LR_DECAY ** (step / self.max_steps))
