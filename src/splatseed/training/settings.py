"""The settings of a run.

Notation: a *step* renders one training view. A strategy whose name ends in ``-3dgs`` trains in
3DGS's conventions, as gsplat's trainer has them, for comparison with published numbers; see
``schedule``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatseed.checkup.choices import UnfitPoints
from splatseed.findings import Finding
from splatseed.io.regions import REGION_FORM
from splatseed.photos.sizes import TRAINED_SIDE, default_factor
from splatseed.progress import Note, silent_note
from splatseed.scene import TEST_EVERY, Image
from splatseed.settings import Range, check_settings
from splatseed.training.schedule import FULL_RUN, Schedule, continued, make_schedule
from splatseed.training.traits import AS_3DGS, NAMES, STRATEGIES, StrategyTraits, strategy_traits

if TYPE_CHECKING:
    StrategyName = str
else:
    StrategyName = Literal[NAMES]

Backend = Literal["auto", "cpu", "cuda"]
Placing = Literal["stereo", "none"]
Seeding = Literal["advised", "auto", "scene"]
Exposure = Literal["none", "affine"]

MIN_GAUSSIANS = 2
BUDGET = 1_000_000
"""The cap of strategies with a default budget, where the user sets none."""
BYTES_PER_GAUSSIAN = 2000
"""Memory per Gaussian in training: its 59 numbers, their gradients and two moments (944 bytes),
and as much again for the rasteriser's lists and for copies while Gaussians are added."""


@dataclass(frozen=True)
class TrainSettings:
    """How to train.

    Options of ``train``, arguments of ``ss.train``, plans of ``bench`` and ``config.json`` have
    these fields, with their docstrings and defaults (two defaults of ``train`` differ:
    ``request.DEFAULTS``). Suppressed fields are not options; files of ``train --config``, plans,
    and ``ss.train`` set them.

    Raises:
        ParameterError: A value has another type or is out of range.
    """

    strategy: StrategyName = "default"  # of train: "auto"
    """How Gaussians are added. grow: where renders are wrong, within a budget; auto: as grow does,
    which scored best; mcmc: as MCMC does, up to a budget; strategy default: as 3DGS does; none: not
    at all; -3dgs: 3DGS's own rates, sizes and schedules, to compare with published numbers."""
    max_steps: Annotated[int, Range(1)] = FULL_RUN
    """Training steps; schedules and learning rates adapt to them. With fewer than 12 photographs
    to train on, train takes 1500 by default."""
    data_factor: Annotated[int | float | None, Range(1)] = None
    """Divide the width and height of the photographs by this number; by default by the smallest
    whole one that leaves at most 1600 pixels on their longer side."""
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
    test_every: Annotated[int, Range(2, also=0)] = TEST_EVERY
    """Keep every n-th image, sorted by name, for testing; 0: none. Of fewer than 12 photographs,
    train keeps none by default."""
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
    seeding: Annotated[Seeding, tyro.conf.arg(name="seeds")] = "scene"  # of train: "advised"
    """Start from the scene's points as they are (scene), with those that method auto adds from the
    training photographs (auto), or as splatseed info advises for this strategy and budget
    (advised). Points that splatseed has added already, and 3DGS's conventions, are left alone."""
    region: Annotated[str | None, tyro.conf.arg(metavar=REGION_FORM)] = None
    """Add points in this region alone, even where none are advised: a box, a sphere, or a turned
    box, as of splatseed upsample; the scene's own points stay. Write --region=-1,... if the first
    number is negative."""

    unfit_points: UnfitPoints = "drop"
    """What to do with the scene's points where photographs contradict them: leave them out, move
    them by the similarity that fits, or keep them."""

    drop_wrong_poses: bool = False
    """Leave out single photographs whose poses do not fit the points that other photographs
    confirm."""

    def __post_init__(self) -> None:
        check_settings(self)

    def with_data_factor(self, images: Sequence[Image], note: Note = silent_note) -> TrainSettings:
        """Set the default data factor where the user set none; note it if it downsamples."""
        if self.data_factor is not None:
            return self
        factor = default_factor(images)
        if factor > 1:
            lens = max((im.lens for im in images), key=lambda lens: max(lens.width, lens.height))
            stored = f"{lens.width:,} x {lens.height:,}"
            size = f"{lens.width // factor:,} x {lens.height // factor:,}"
            text = f"Photographs of {stored} pixels are used at {size}, as the default is "
            text += f"{TRAINED_SIDE:,} a side at most: `data_factor=1` keeps their size."
            note(Finding("downsampled-photographs", text, "info"))
        return replace(self, data_factor=factor)

    @property
    def factor(self) -> float:
        """The data factor; 1 before ``with_data_factor``."""
        return self.data_factor or 1

    @property
    def traits(self) -> StrategyTraits:
        """The strategy's description; for ``auto`` that of ``grow``."""
        return strategy_traits(self.strategy)

    @property
    def as_3dgs(self) -> bool:
        """Whether rates, sizes and schedules are 3DGS's."""
        return self.strategy.endswith(AS_3DGS)

    @property
    def uses_stereo(self) -> bool:
        """Whether the strategy places Gaussians at depths that stereo finds."""
        return self.traits.uses_stereo and self.placing == "stereo"

    @property
    def unused(self) -> tuple[str, ...]:
        """Settings that differ from their defaults but that only another strategy reads."""
        others = [each for each in STRATEGIES.values() if each is not self.traits]
        names = [name for each in others for name in each.own_settings]
        return tuple(name for name in names if getattr(self, name) != getattr(type(self), name))

    @property
    def schedule(self) -> Schedule:
        """The run's hyperparameters and their timing."""
        schedule = make_schedule(self.traits, self.max_steps, as_3dgs=self.as_3dgs)
        return continued(schedule) if self.start else schedule

    def max_seeds(self, cap: int) -> int:
        """Return the maximum number of seeds of a run of up to ``cap`` Gaussians."""
        return max(2, round(self.traits.seed_share * cap))

    @property
    def cap(self) -> int | None:
        """The maximum number of Gaussians; None for no limit."""
        if self.cap_max is None and self.traits.has_default_budget:
            return BUDGET
        return self.cap_max
