"""The settings of a run.

Notation: a *step* renders one training view. A strategy whose name ends in ``-3dgs`` trains in
3DGS's conventions, as gsplat's trainer has them, for comparison with published numbers; see
``schedule``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, cast

import tyro

from splatseed.photos.sizes import TRAINED_SIDE, default_factor
from splatseed.scene import Image
from splatseed.settings import Range, check_settings
from splatseed.training.schedule import FULL_RUN, Densification, Schedule, continued, make_schedule

StrategyName = Literal[
    "auto", "default", "grow", "mcmc", "none", "default-3dgs", "mcmc-3dgs", "none-3dgs"
]
Backend = Literal["auto", "cpu", "cuda"]
Placing = Literal["stereo", "none"]
Seeding = Literal["advised", "auto", "scene"]
Exposure = Literal["none", "affine"]

MIN_GAUSSIANS = 2
BUDGET = 1_000_000
"""Default cap of the strategies that have a budget."""
AS_3DGS = "-3dgs"
SEED_SHARE = {"default": 0.7, "mcmc": 0.7}
"""Maximum seeds as a fraction of the budget, for strategies that add Gaussians; else 1."""

BYTES_PER_GAUSSIAN = 2000
"""Memory per Gaussian in training: its 59 numbers, their gradients and two moments (944 bytes),
and as much again for the rasteriser's lists and for copies while Gaussians are added."""


@dataclass(frozen=True)
class TrainSettings:
    """How to train.

    Options of ``train``, arguments of ``ss.train``, plans of ``bench`` and ``config.json`` have
    these fields, with their defaults and docstrings. Suppressed fields are not options; files of
    ``train --config``, plans, and ``ss.train`` set them.

    Raises:
        ParameterError: A value has another type or is out of range.
    """

    strategy: StrategyName = "default"
    """Densify as 3DGS does (default), grow within a budget where renders are wrong (grow), densify
    as MCMC does up to a budget (mcmc), keep the number of seeds (none), or what measured best, grow
    (auto); -3dgs: 3DGS's own rates, sizes and schedules, to compare with published numbers."""
    max_steps: Annotated[int, Range(1)] = FULL_RUN
    """Training steps; schedules and learning rates adapt to them."""
    data_factor: Annotated[int | None, Range(1)] = None
    """Divide the width and height of the photographs by this whole number; by default by the
    smallest that leaves at most 1600 pixels on their longer side."""
    seed: Annotated[int, Range(0)] = 0
    """Random seed; on the CPU, runs repeat exactly."""
    # The option is --budget.
    cap_max: tyro.conf.Suppress[Annotated[int | None, Range(MIN_GAUSSIANS)]] = None
    """Maximum Gaussians, by default 1000000 for grow and mcmc; if there are more seeds, they are
    thinned."""
    backend: Backend = "auto"
    """Where to train; auto takes a GPU if PyTorch sees one."""
    sh_degree: tyro.conf.Suppress[Annotated[int, Range(0, 3)]] = 3
    """Degree of the spherical harmonics: how finely colours depend on the viewing direction, 0 to
    3."""
    test_every: Annotated[int, Range(2)] = 8
    """Keep every n-th image, sorted by name, for testing."""
    exposure: Exposure = "none"
    """Colour transform of each training photograph, learnt with the Gaussians, for photographs of
    changing exposure or white balance: affine, or none. Judge by the colour-corrected PSNR."""
    placing: tyro.conf.Suppress[Placing] = "stereo"
    """Strategy grow: put most of the new Gaussians on wrong pixels, at the depth that stereo finds
    there (stereo), or only split Gaussians (none)."""
    opacity_reset: tyro.conf.Suppress[bool] = False
    """Lower all opacities from time to time, as 3DGS does (strategy default; gsplat 1.5.3 does
    not)."""
    seed_sizes: tyro.conf.Suppress[bool] = False
    """Start with the sizes in the scene's seeds.npz instead of the gaps between seeds."""
    seed_normals: tyro.conf.Suppress[bool] = False
    """Start with flat discs where the scene's seeds.npz has normals."""
    seed_colors: tyro.conf.Suppress[bool] = False
    """Start with the colours that the training photographs show for each seed, by direction."""
    start: Annotated[str | None, tyro.conf.arg(metavar="MODEL|RUN")] = None
    """Continue from trained Gaussians instead of points: a run, or any trainer's file of this
    scene, edited or not. Holes are filled where the strategy adds Gaussians."""
    seeding: tyro.conf.Suppress[Seeding] = "scene"  # the option is --seeds, "advised" by default
    """Start from the scene's points as they are, let method ``auto`` add the points that the
    training photographs need, or do what ``splatseed info`` advises. Points that splatseed has
    added already, and 3DGS's conventions, are left alone."""

    def __post_init__(self) -> None:
        check_settings(self)

    def with_data_factor(
        self, images: Sequence[Image], note: Callable[[str], None] = lambda _: None
    ) -> TrainSettings:
        """Set the default data factor where the user set none; note it if it downsamples."""
        if self.data_factor is not None:
            return self
        factor = default_factor(images)
        if factor > 1:
            lens = max((im.lens for im in images), key=lambda lens: max(lens.width, lens.height))
            stored = f"{lens.width:,} x {lens.height:,}"
            size = f"{lens.width // factor:,} x {lens.height // factor:,}"
            note(
                f"Photographs of {stored} pixels are used at {size}, as the default is "
                f"{TRAINED_SIDE:,} a side at most: `data_factor=1` keeps their size."
            )
        return replace(self, data_factor=factor)

    @property
    def factor(self) -> int:
        """The data factor; 1 before ``with_data_factor``."""
        return self.data_factor or 1

    @property
    def densification(self) -> Densification:
        """The strategy without its conventions; for ``auto`` the one that measured best."""
        if self.strategy == "auto":
            return "grow"
        return cast("Densification", self.strategy.removesuffix(AS_3DGS))

    @property
    def unused(self) -> tuple[str, ...]:
        """Settings that differ from their defaults but have no effect on this strategy."""
        given = (
            ("opacity_reset", self.opacity_reset, "default"),
            ("placing", self.placing != "stereo", "grow"),
        )
        return tuple(name for name, set_, of in given if set_ and self.densification != of)

    @property
    def schedule(self) -> Schedule:
        """The run's hyperparameters and their timing."""
        as_3dgs = self.strategy.endswith(AS_3DGS)
        schedule = make_schedule(self.densification, self.max_steps, as_3dgs=as_3dgs)
        return continued(schedule) if self.start else schedule

    def max_seeds(self, cap: int) -> int:
        """Return the maximum number of seeds of a run of up to ``cap`` Gaussians."""
        return max(2, round(SEED_SHARE.get(self.densification, 1.0) * cap))

    @property
    def cap(self) -> int | None:
        """The maximum number of Gaussians; None for no limit."""
        if self.cap_max is None and self.densification in ("grow", "mcmc"):
            return BUDGET
        return self.cap_max
