"""The strategies and what each needs: all that is known of a strategy without PyTorch.

To add one, write a subclass of ``strategies.base.Strategy`` in a file of ``strategies/``, and
describe it in ``_ALL``: the command line, ``ss.train`` and plans then accept its name. The help of
``TrainSettings.strategy`` and docs/training.md describe it to users.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

AS_3DGS = "-3dgs"
"""Suffix of a strategy's name: with 3DGS's rates, sizes and schedules."""
AUTO, BEST = "auto", "grow"
"""A name in settings, and the strategy that it stands for, which measured best."""
GROW_EVERY = 2000
"""Steps of a full run between rounds of ``grow``, and before the first: a long round measures
contributions to many photographs."""
FULL_AT = 0.35
"""Fraction of the run by which ``grow`` has spent its budget."""


@dataclass(frozen=True)
class StrategyTraits:
    """What a strategy needs, and its timing in a run of 30,000 steps."""

    name: str
    implementation: str  # its class, as "file:class" in ``strategies/``
    number_grows: bool = True  # the number of Gaussians grows; for estimates of time
    has_default_budget: bool = False  # without --budget, ``settings.BUDGET`` is the cap
    seed_share: float = 1.0  # maximum seeds as a fraction of the budget
    uses_stereo: bool = False  # places Gaussians at depths that stereo finds
    own_settings: tuple[str, ...] = ()  # fields of ``TrainSettings`` that no other strategy uses
    in_3dgs: bool = True  # exists in 3DGS's conventions, too: NAME-3dgs
    refine_stop: int = 15_000  # step at which densification ends: ``Schedule.refine_stop``
    min_rounds: int = 1
    """Minimum number of densifications without ``round_steps``. A short run densifies every 100
    steps, and more often only to reach it: gradients averaged over few photographs are noise."""
    round_steps: int | None = None
    """Steps of a full run between densifications, and the step at which they start. Scaled to the
    run, but at least ``schedule.MIN_ROUND_STEPS`` (20); not used in 3DGS's conventions. None: 100
    and 500, as in 3DGS."""
    full_at: float | None = None
    """Fraction of the run by which the budget is spent, for estimates of time; None: when
    densification ends."""
    first_opacity: float = 0.1  # of a seed's Gaussian
    first_size: float = 1.0  # in 3DGS's conventions: its size, as a multiple of the gap to others
    why_no_seeds: str = ""
    """Why ``train`` adds no seeds, and ``info`` advises none, where points cover the pictures;
    empty if more seeds help there, too."""


_ALL = (
    StrategyTraits(
        "default", "default:Default", seed_share=0.7, own_settings=("opacity_reset",), min_rounds=6
    ),
    StrategyTraits(
        "grow",
        "grow:ErrorDensification",
        has_default_budget=True,
        uses_stereo=True,
        own_settings=("placing",),
        in_3dgs=False,
        round_steps=GROW_EVERY,
        full_at=FULL_AT,
        why_no_seeds="Strategy grow puts new Gaussians at the depth that stereo finds. 3DGS's "
        "densification, which other trainers use, does not: for them splatseed upsample adds "
        "points.",
    ),
    StrategyTraits(
        "mcmc",
        "mcmc:Mcmc",
        has_default_budget=True,
        seed_share=0.7,
        refine_stop=25_000,
        min_rounds=24,
        first_opacity=0.5,
        first_size=0.1,
    ),
    StrategyTraits("none", "base:Strategy", number_grows=False),
)
STRATEGIES: Mapping[str, StrategyTraits] = MappingProxyType(
    {traits.name: traits for traits in _ALL}
)
NAMES = (AUTO, *STRATEGIES, *(f"{each.name}{AS_3DGS}" for each in _ALL if each.in_3dgs))
"""The names of strategies in settings."""


def strategy_traits(name: str) -> StrategyTraits:
    """Return the traits of a strategy by one of ``NAMES``."""
    return STRATEGIES[BEST if name == AUTO else name.removesuffix(AS_3DGS)]
