"""A plan: which scenes, which arms, how often, and how each run is trained.

Notation: see ``records``. Promise: a plan that exists is valid; its runs are ordered so that all
arms of all scenes have been run once before any is repeated, and a benchmark stopped early still
compares all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

from splatseed.bench.planning.records import (
    ANY_RATIO,
    CLOUD,
    SFM,
    WITH_CLOUD,
    Arm,
    RunSpec,
    needs_cloud,
    plain,
)
from splatseed.bench.planning.scenes import SceneFacts
from splatseed.errors import ParameterError
from splatseed.literal import did_you_mean
from splatseed.seeding.upsampling import RHO, parse_budget
from splatseed.train.settings import Backend, StrategyName, TrainSettings
from splatseed.upsample import METHODS, Profile, Upsampler, chooses_number, configure

DEMO = "demo:"
"""The path of the synthetic room, which is made in the benchmark's folder on demand."""
DEPTH = "depth"
SEE = "See splatseed bench --help."
LARGEST_IMAGE = 1e9
"""Pixels; a budget per pixel that allows not one Gaussian of such an image is none."""
LEAST_SIDE = 11
"""Least side of a photograph in pixels, for SSIM's window."""


@dataclass(frozen=True)
class PlannedScene:
    """A scene of a plan.

    Args:
        path: Its folder; ``DEMO`` for the synthetic room.
        name: Its name in tables; the folder's name when left empty.
        images: The folder of photographs within it, such as ``images_4``; detected when left empty.
        depth: The folder of its depth maps; looked for in the scene when left out.
        cloud: The file of its scan, in the scene's frame.
    """

    path: str
    name: str = ""
    images: str = ""
    depth: str = ""
    cloud: str = ""

    @property
    def is_demo(self) -> bool:
        """Whether it is the synthetic room."""
        return self.path == DEMO

    @property
    def label(self) -> str:
        """Its name, or its folder's."""
        return self.name or ("demo" if self.is_demo else Path(self.path).resolve().name)


@dataclass(frozen=True)
class Plan:
    """What a benchmark should run.

    Raises:
        ParameterError: A value is out of its range, or given twice.
    """

    scenes: tuple[PlannedScene, ...] = ()
    """The scenes."""
    methods: tuple[str, ...] = (SFM, "linear", "mls")
    """How new points are made; ``sfm`` for none, with which all others are compared; ``cloud+auto``
    for those of a scan and, where it has none, of ``auto``."""
    ratios: tuple[float, ...] = (8.0,)
    """Points in all, per original; empty if budgets determine the number."""
    budgets: tuple[str, ...] = ()
    """Most Gaussians at the end, the same for every arm: numbers, or such as "0.25rho", per pixel
    of a photograph at training size. Seeds are thinned to them, or for strategies that add
    Gaussians to the fraction they begin with."""
    strategies: tuple[StrategyName, ...] = ("default",)
    """Densification strategies."""
    profiles: tuple[Profile, ...] = ("default",)
    """Parameters of the methods: improved ones, and those of the paper's text."""
    repeats: int = 3
    """Number of repeats, with another seed each time."""
    training: TrainSettings = field(default_factory=TrainSettings)
    """How each run is trained; strategy and seed are those of its arm and its repeat."""
    long_side: int | None = None
    """Pixels of the longer side of photographs, at most: for each scene its own data factor."""
    keep_models: bool = False
    """Whether trained models are kept."""
    lpips: bool = False
    """Whether LPIPS is measured; its weights must be there."""
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Parameters that differ from the profile's, by method."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "ratios", tuple(float(ratio) for ratio in self.ratios))
        object.__setattr__(self, "budgets", tuple(map(_budget, self.budgets)))
        _check_choices("methods", self.methods, (SFM, *METHODS, *WITH_CLOUD))
        _check_choices("strategies", self.strategies, get_args(StrategyName))
        _check_choices("profiles", self.profiles, get_args(Profile))
        if self.ratios or not self.budgets:
            _check_distinct("ratios", self.ratios)
        if self.budgets:
            _check_distinct("budgets", self.budgets)
            if self.training.cap_max is not None:
                raise _out_of_range("budgets or cap_max", "one of them", "both")
        if self.long_side is not None:
            self._check_long_side(self.long_side)
        for ratio in self.ratios:
            if not 1 < ratio < math.inf:
                raise _out_of_range("ratios", "above 1 (points in all, per original)", ratio)
        if self.repeats < 1:
            raise _out_of_range("repeats", "of 1 or more", self.repeats)
        _check_distinct("scenes", [each.label for each in self.scenes])
        for scene in self.scenes:
            _check_text(scene)
        for method in self.parameters:
            _check_choices("parameters", (method,), tuple(METHODS))
            configure(method, **self.parameters[method])

    def _check_long_side(self, long_side: int) -> None:
        if long_side < LEAST_SIDE:
            raise _out_of_range("long_side", f"of {LEAST_SIDE} or more", long_side)
        if self.training.data_factor != 1:
            raise _out_of_range("long_side or data_factor", "one of them", "both")

    def parameters_of(self, method: str) -> Mapping[str, Any]:
        """Differences from the profile; no method sees the held-out test photographs."""
        looks = hasattr(METHODS[plain(method)], "hold_out")
        held = {"hold_out": self.training.test_every} if looks else {}
        return MappingProxyType({**held, **self.parameters.get(plain(method), {})})

    def arms(self, strategy: StrategyName) -> tuple[Arm, ...]:
        """The arms of one strategy: for each budget, the original cloud first.

        A method whose profiles are identical has one arm, of the first profile; one that chooses
        its number of seeds has no ratio.
        """
        arms = []
        for budget in self.budgets or ("",):
            if SFM in self.methods:
                arms.append(Arm(SFM, "default", 1, strategy, budget))
            for method in self.methods:
                if method != SFM:
                    arms += [
                        Arm(method, profile, ratio, strategy, budget)
                        for profile in self._profiles_of(method)
                        for ratio in self._ratios_of(method)
                    ]
        return tuple(arms)

    def _ratios_of(self, method: str) -> tuple[float, ...]:
        return (ANY_RATIO,) if chooses_number(plain(method)) or not self.ratios else self.ratios

    def _profiles_of(self, method: str) -> list[Profile]:
        seen: list[Upsampler] = []
        chosen = []
        for profile in self.profiles:
            configured = configure(plain(method), profile, **self.parameters_of(method))
            if configured not in seen:
                seen.append(configured)
                chosen.append(profile)
        return chosen


def plan_runs(
    plan: Plan, scenes: Sequence[SceneFacts], backend: Backend, version: str
) -> list[RunSpec]:
    """The runs of a plan, in the order in which they should be run.

    Arms of the method depth are left out for scenes without depth maps, and those that need a scan
    for scenes without one.

    Args:
        plan: The plan.
        scenes: Facts about its scenes.
        backend: Where they will be trained: not "auto".
        version: The package's.
    """
    return [
        RunSpec(
            scene=scene.name,
            scene_digest=scene.digest,
            arm=arm,
            repeat=repeat,
            parameters=_parameters(plan, arm.method),
            depth_digest=scene.depth_digest if arm.method == DEPTH else "",
            depth_path=scene.depth_path if arm.method == DEPTH else "",
            cloud_digest=scene.cloud_digest if needs_cloud(arm.method) else "",
            cloud_path=scene.cloud_path if needs_cloud(arm.method) else "",
            scene_path=scene.path,
            images=scene.images,
            training=_training(plan, scene, arm, backend),
            version=version,
        )
        for repeat in range(plan.repeats)
        for scene, arm in _scene_arms(plan, scenes)
    ]


def _parameters(plan: Plan, method: str) -> dict[str, Any]:
    """A method's parameters; those of the scan beside it begin with ``cloud.``."""
    if method == SFM:
        return {}
    own = dict(plan.parameters_of(method))
    if method not in WITH_CLOUD:
        return own
    return own | {f"{CLOUD}.{name}": value for name, value in plan.parameters_of(CLOUD).items()}


def _training(plan: Plan, scene: SceneFacts, arm: Arm, backend: Backend) -> TrainSettings:
    """The plan's settings, at the size and with the number of Gaussians that this scene has."""
    factor = plan.training.data_factor
    if plan.long_side is not None:
        factor = max(1, -(-scene.long_side // plan.long_side))
    settings = replace(plan.training, backend=backend, data_factor=factor)
    if not arm.budget:
        return settings
    return replace(settings, cap_max=max(2, parse_budget(arm.budget, scene.pixels_at(factor))))


def _budget(given: object) -> str:
    """A budget in the plan's form, so that 20000, "20k" and "20000.0" are the same.

    Raises:
        ParameterError: It is not a budget.
    """
    text = str(given).strip().lower()
    number = parse_budget(text, pixels=LARGEST_IMAGE)
    if text.endswith(RHO):
        return f"{float(text.removesuffix(RHO)):g}{RHO}"
    if number < 2:
        raise _out_of_range("budgets", "of at least 2 Gaussians", given)
    return f"{number}"


def _scene_arms(plan: Plan, scenes: Sequence[SceneFacts]) -> list[tuple[SceneFacts, Arm]]:
    pairs = [
        (scene, arm)
        for scene in scenes
        for strategy in plan.strategies
        for arm in plan.arms(strategy)
        if (arm.method != DEPTH or scene.depth_digest)
        and (not needs_cloud(arm.method) or scene.cloud_digest)
    ]
    if plan.budgets:  # runs that come to the same seeds as sfm's take over their training
        pairs.sort(key=lambda pair: pair[1].method != SFM)
    return pairs


def _check_choices(name: str, given: Sequence[str], known: Sequence[str]) -> None:
    _check_distinct(name, given)
    for each in given:
        if each not in known:
            see = did_you_mean(each, known) or SEE
            raise ParameterError(f"{name} among {', '.join(known)}", found=each, fix=see.strip())


def _check_distinct(name: str, given: Sequence[object]) -> None:
    if name not in {"scenes", "parameters"} and not given:
        raise _out_of_range(name, "of at least one", "none")
    twice = next((each for i, each in enumerate(given) if each in given[:i]), None)
    if twice is not None:
        raise ParameterError(
            f"{name} that differ",
            found=f"{twice} twice",
            fix="Give names to scenes in a plan (see --dry-run)."
            if name == "scenes"
            else "Drop one.",
        )


def _check_text(scene: PlannedScene) -> None:
    """A plan is a text file, which cannot hold file names that are not text."""
    try:
        f"{scene.path}{scene.name}{scene.images}{scene.depth}{scene.cloud}".encode()
    except UnicodeEncodeError:
        raise ParameterError(
            "scenes whose paths are valid text", found=ascii(scene.path), fix="Rename the folder."
        ) from None


def _out_of_range(name: str, expected: str, found: object) -> ParameterError:
    return ParameterError(f"{name} {expected}", found=f"{found}", fix=SEE)
