"""The settings of a run: what a user may choose.

Notation: a *step* shows one photograph. A strategy's name that ends in ``-3dgs`` trains in 3DGS's
conventions, as gsplat's trainer has them, to compare with published numbers; see ``schedule``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

from splatseed.errors import ParameterError
from splatseed.train.schedule import FULL_RUN, Densification, Schedule, make_schedule

__all__ = ["AS_3DGS", "BUDGET", "BYTES_EACH", "Backend", "Seeding", "StrategyName", "TrainSettings"]

StrategyName = Literal["default", "grow", "mcmc", "none", "default-3dgs", "mcmc-3dgs", "none-3dgs"]
Backend = Literal["auto", "cpu", "cuda"]
Seeding = Literal["auto", "scene"]

BUDGET = 1_000_000
"""Most Gaussians of the strategies that have a budget, where none is given."""
AS_3DGS = "-3dgs"

BYTES_EACH = 2000
"""Memory of a Gaussian in training: its 59 numbers, their gradients and two moments (944 bytes), and as
much again for the rasteriser's lists and for copies while Gaussians are added."""


@dataclass(frozen=True)
class TrainSettings:
    """How to train.

    Raises:
        ParameterError: A value is out of its range.
    """

    strategy: StrategyName = "default"
    """How Gaussians are added and removed: 3DGS's densification, growth within a budget where the
    photographs are wrong, MCMC up to a cap, or not at all; with ``-3dgs`` also in 3DGS's own conventions of rates, sizes and schedules."""
    max_steps: int = FULL_RUN
    """Training steps; schedules and learning rates are adapted to them."""
    data_factor: int = 1
    """By how much the photographs are made smaller, a whole number."""
    seed: int = 0
    """On the CPU the same seed gives the same bytes."""
    cap_max: int | None = None
    """Most Gaussians: more seeds are thinned (default: 1,000,000 for grow and mcmc, else no limit)."""
    backend: Backend = "auto"
    """Where to train; auto takes a GPU if PyTorch sees one."""
    sh_degree: int = 3
    """Degree of the spherical harmonics that colours depend on the direction by, 0 to 3."""
    test_every: int = 8
    """Of the images sorted by name, every so many-th is kept for the test."""
    opacity_reset: bool = False
    """With strategy default, lower all opacities at times as 3DGS does; gsplat 1.5.3 does not."""
    seed_sizes: bool = False
    """Begin with the sizes that ``seeds.npz`` knows, else with those of the gaps between seeds."""
    seed_normals: bool = False
    """Begin with flat discs where ``seeds.npz`` knows the normals, else with balls alone."""
    seed_colors: bool = False
    """Begin with the colours that the training photographs show a seed in, by direction, not its own."""
    seeding: Seeding = "scene"
    """Begin with the scene's points as they are, or let method ``auto`` add to them what the training
    photographs ask for. Points that splatseed has added already, and 3DGS's conventions, are left alone."""

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
    def densification(self) -> Densification:
        """The strategy, whatever the conventions."""
        return cast("Densification", self.strategy.removesuffix(AS_3DGS))

    @property
    def schedule(self) -> Schedule:
        """The run's numbers, and when things happen."""
        as_3dgs = self.strategy.endswith(AS_3DGS)
        return make_schedule(self.densification, self.max_steps, as_3dgs=as_3dgs)

    @property
    def cap(self) -> int | None:
        """Most Gaussians; None for no limit."""
        if self.cap_max is None and self.densification in ("grow", "mcmc"):
            return BUDGET
        return self.cap_max
