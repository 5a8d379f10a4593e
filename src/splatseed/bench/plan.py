"""A plan: which scenes, which arms, how often, how each run is trained; and the runs that follow.

An *arm* is everything about a run except its scene and its repeat. A plan that exists is valid;
its runs are ordered so that all arms of all scenes have been run once before any is repeated.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Self, get_args

from splatseed.bench.scenes import PlannedScene, SceneFacts
from splatseed.errors import ParameterError
from splatseed.methods import METHODS, Profile, Upsampler, chooses_number, configure
from splatseed.photos.view import TRAINED_SIDE
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scores import CurvePoint, EvalResult
from splatseed.seeding.upsampling import RHO, parse_budget
from splatseed.text import did_you_mean
from splatseed.training.duration import GROWTH, step_seconds
from splatseed.training.seeds import most_seeds
from splatseed.training.settings import Backend, StrategyName, TrainSettings

SFM = "sfm"
"""The method that leaves the cloud of Structure-from-Motion as it is; its ratio is 1."""
ANY_RATIO = 0.0
"""The ratio of methods that choose their number of seeds, and of all if a budget determines it."""
DEPTH, CLOUD = "depth", "cloud"
"""The methods that need a scene's depth maps, and its scan."""
WITH_CLOUD = ("cloud+auto", "cloud+stereo", "cloud+cover")
"""A scan's seeds, and those that another method puts where it has none."""
SEE = "See splatseed bench --help."
SHARED = tuple(
    each.name
    for each in fields(TrainSettings)
    if each.name not in {"strategy", "seed", "seeding", "start"}
)
"""Settings that all runs of a plan share; arms and repeats determine the others."""
_WHAT = ("name", "digest", "depth_digest", "cloud_digest")
"""What of a scene determines results; the rest says where it lies, or follows from it."""
_LISTS = ("methods", "strategies", "profiles", "ratios", "budgets")
_DEFAULT = TrainSettings()
_ADDED, _ADDED_PER_PIXEL = 3e5, 3.0
"""And those that 3DGS's conventions add in runs of any length: fern's 6,000 SfM points were 265,000
after 60 steps at 75 x 100 pixels, 570,000 in the first quarter of 7,000 at 300 x 400."""
_LIKELY_RATIO = 3.0
"""Seeds per original, for methods that look at photographs."""
_TESTS = 21
"""How often the test views are rendered: during training, and at the end."""
_LARGEST_IMAGE = 1e9
"""Pixels; a budget per pixel that allows not one Gaussian of such an image is none."""
_LEAST_SIDE = 11
"""Least side of a photograph in pixels, for SSIM's window."""


def plain(method: str) -> str:
    """The method, without the scan that its seeds come beside."""
    return method.removeprefix(f"{CLOUD}+")


def needs_cloud(method: str) -> bool:
    """Whether a method needs the scene's scan."""
    return method == CLOUD or method in WITH_CLOUD


@dataclass(frozen=True)
class Arm:
    """How a scene is seeded and trained."""

    method: str
    """``SFM``, a key of ``splatseed.METHODS``, or one of ``WITH_CLOUD``."""
    profile: Profile
    ratio: float
    """Points in all, per original; ``ANY_RATIO`` if photographs or the budget decide."""
    strategy: StrategyName
    budget: str = ""
    """As in ``Plan``, one of them; empty for no limit."""

    def __post_init__(self) -> None:
        # 8 and 8.0 are the same ratio, and must give the same key.
        object.__setattr__(self, "ratio", float(self.ratio))

    @property
    def label(self) -> str:
        """In a few words, such as ``mls 8x`` or ``mls 8x (paper)``; the strategy is left out."""
        if self.method == SFM:
            return SFM
        ratio = f" {self.ratio:g}x" if self.ratio else ""
        return f"{self.method}{ratio}" + (" (paper)" if self.profile == "paper" else "")


@dataclass(frozen=True)
class RunSpec:
    """One run: everything that determines its result, and where its scene is."""

    scene: SceneFacts
    """With depth maps or a scan only where the method needs them."""
    arm: Arm
    repeat: int
    """From 0; seeds both upsampling and training."""
    training: TrainSettings = _DEFAULT
    """The settings; the arm gives the strategy, the repeat the seed."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """The method's parameters that differ from its profile's."""
    version: str = ""

    @property
    def key(self) -> str:
        """The fingerprint of everything that determines the result: 32 hexadecimal digits."""
        told = {**self.to_dict(), "scene": [getattr(self.scene, name) for name in _WHAT]}
        text = json.dumps(told, sort_keys=True, separators=(",", ":"))
        return fingerprint(text.encode())

    @property
    def settings(self) -> TrainSettings:
        """How to train, with the arm's strategy and the repeat's seed."""
        return replace(self.training, strategy=self.arm.strategy, seed=self.repeat)

    @property
    def most_seeds(self) -> int | None:
        """The number that seeds are thinned to under a budget; None without one."""
        if not self.arm.budget or self.training.cap_max is None:
            return None
        return most_seeds(self.settings, self.training.cap_max)

    @property
    def gaussians(self) -> tuple[float, float]:
        """Gaussians at the start and at the end, as far as is known before."""
        cap = self.settings.cap or math.inf
        made = self.scene.num_points * (self.arm.ratio or _LIKELY_RATIO)
        seeds = min(made, self.most_seeds or cap)
        grown = seeds if self.settings.densification == "none" else seeds * GROWTH
        if self.arm.strategy == "default-3dgs":
            pixels = self.scene.pixels_at(self.training.factor)
            grown = seeds + _ADDED + _ADDED_PER_PIXEL * pixels
        return seeds, min(grown, cap)

    def seconds(self, threads: int) -> float:
        """Seconds on so many threads by a rough model, which can be several times off.

        A step's are those of ``train.duration``.
        """
        on_gpu = self.training.backend == "cuda"
        around = 20.0 if on_gpu else 6.0
        pixels = self.scene.pixels_at(self.training.factor)
        step = step_seconds("cuda" if on_gpu else "cpu", sum(self.gaussians) / 2, pixels)
        renders = 0.3 * _TESTS * self.scene.num_images / self.training.test_every
        grows, method = self.settings.densification == "grow", plain(self.arm.method)
        compares = grows or (method != SFM and chooses_number(method))
        compared = 0.8 * self.scene.num_images if compares else 0.0
        slower = 1.0 if on_gpu else 2 / threads
        return around + slower * (step * (self.training.max_steps + renders) + compared)

    def to_dict(self) -> dict[str, Any]:
        """As plain values; of the settings, those that differ from their defaults."""
        settings = vars(self.training).items()
        told = {name: value for name, value in settings if value != getattr(_DEFAULT, name)}
        return {**asdict(self), "parameters": dict(self.parameters), "training": told}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of ``to_dict``."""
        scene = SceneFacts(**{**values["scene"], "warnings": ()})
        parts = {"arm": Arm(**values["arm"]), "training": TrainSettings(**values["training"])}
        return cls(**{**values, "scene": scene, **parts})


@dataclass(frozen=True)
class RunResult:
    """The result of a run: ``scores`` of the test views at the end, ``curve`` during training."""

    scores: EvalResult
    curve: tuple[CurvePoint, ...]
    num_seeds: int
    """Points that training began with."""
    upsample_seconds: float
    """Wall time of making the seeds, thinning included; 0 for plain ``SFM``."""
    train_seconds: float
    """Wall time of the training steps alone."""
    peak_bytes: int | None
    """Peak memory of the process; None where the system does not tell."""
    device: str
    peak_gpu_bytes: int | None = None
    wall_seconds: float = 0.0
    """Wall time of the whole run, with reading, tests and pictures."""

    @property
    def psnr(self) -> float:
        """Mean over test images of each one's PSNR, dB."""
        return self.scores.psnr

    @property
    def num_gaussians(self) -> int:
        """Gaussians at the end."""
        return self.scores.num_gaussians or 0

    @property
    def seconds(self) -> float:
        """Seconds of making the seeds and training from them."""
        return self.upsample_seconds + self.train_seconds

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**own, "scores": self.scores.to_dict(), "curve": list(map(asdict, self.curve))}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of ``to_dict``."""
        scores = EvalResult.from_dict(values["scores"])
        curve = tuple(CurvePoint(**each) for each in values["curve"])
        return cls(**{**values, "scores": scores, "curve": curve})


@dataclass(frozen=True)
class Plan:
    """What a benchmark should run.

    Raises:
        ParameterError: A value is out of its range, or given twice.
    """

    scenes: tuple[PlannedScene, ...] = ()
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
    uncapped: tuple[StrategyName, ...] = ()
    """Strategies to which budgets do not apply: they end with as many Gaussians as they make."""
    profiles: tuple[Profile, ...] = ("default",)
    """Parameters of the methods: improved ones, and those of the paper's text."""
    repeats: int = 3
    """Number of repeats, with another seed each time."""
    training: TrainSettings = _DEFAULT
    """How each run is trained; strategy and seed are those of its arm and its repeat."""
    long_side: int | None = None
    """Pixels of the longer side of photographs, at most: for each scene its own data factor."""
    keep_models: bool = False
    """Whether trained models are kept."""
    lpips: bool = False
    """Whether LPIPS must be measured; else it is if its weights are there."""
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Parameters that differ from the profile's, by method."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "ratios", tuple(float(ratio) for ratio in self.ratios))
        object.__setattr__(self, "budgets", tuple(map(_budget, self.budgets)))
        known = {"methods": (SFM, *METHODS, *WITH_CLOUD), "strategies": get_args(StrategyName),
                 "uncapped": get_args(StrategyName), "profiles": get_args(Profile),
                 "parameters": tuple(METHODS)}  # fmt: skip
        for name, choices in known.items():
            for each in getattr(self, name):
                if each not in choices:
                    fix = did_you_mean(each, choices).strip() or SEE
                    raise ParameterError(f"{name} among {', '.join(choices)}", found=each, fix=fix)
        lists: dict[str, Any] = {name: getattr(self, name) for name in _LISTS}
        for name, given in {**lists, "scenes": [each.label for each in self.scenes]}.items():
            for each, times in Counter(given).items():
                if times > 1:
                    fix = "Drop one, or give scenes names in a plan (see --dry-run)."
                    raise ParameterError(f"{name} that differ", found=f"{each} twice", fix=fix)
        training, long_side = self.training, self.long_side
        for fits, expected, found in (
            *((lists[name], f"{name} of at least one", "none") for name in _LISTS[:3]),
            (self.ratios or (self.budgets and not self.uncapped), "ratios of at least one", "none"),
            (all(1 < each < math.inf for each in self.ratios),
             "ratios above 1 (points in all, per original)", self.ratios),
            (not self.budgets or training.cap_max is None, "budgets or cap_max", "both"),
            (long_side is None or long_side >= _LEAST_SIDE,
             f"long_side of {_LEAST_SIDE} or more", long_side),
            (long_side is None or training.factor == 1, "long_side or data_factor", "both"),
            (self.repeats >= 1, "repeats of 1 or more", self.repeats),
        ):  # fmt: skip
            if not fits:
                raise ParameterError(expected, found=f"{found}", fix=SEE)
        for method, parameters in self.parameters.items():
            configure(method, **parameters)

    def parameters_of(self, method: str) -> dict[str, Any]:
        """Differences from the profile; those of the scan beside a method begin with ``cloud.``."""
        scan = self._own_parameters(CLOUD) if method in WITH_CLOUD else {}
        beside = {f"{CLOUD}.{name}": value for name, value in scan.items()}
        return {} if method == SFM else self._own_parameters(method) | beside

    def _own_parameters(self, method: str) -> dict[str, Any]:
        """A method's own parameters, and what keeps the test photographs from it."""
        looks = hasattr(METHODS[plain(method)], "test_every")
        held = {"test_every": self.training.test_every} if looks else {}
        return {**held, **self.parameters.get(plain(method), {})}

    def arms(self, strategy: StrategyName) -> tuple[Arm, ...]:
        """The arms of one strategy: for each budget, the original cloud first.

        A method whose profiles are identical has one arm, of the first profile; one that chooses
        its number of seeds has no ratio.
        """
        arms = []
        for budget in (() if strategy in self.uncapped else self.budgets) or ("",):
            if SFM in self.methods:
                arms.append(Arm(SFM, "default", 1, strategy, budget))
            for method in (each for each in self.methods if each != SFM):
                ratios = () if chooses_number(plain(method)) else self.ratios
                arms += [
                    Arm(method, profile, ratio, strategy, budget)
                    for profile in self._profiles_of(method)
                    for ratio in ratios or (ANY_RATIO,)
                ]
        return tuple(arms)

    def _profiles_of(self, method: str) -> list[Profile]:
        named = self._own_parameters(method)
        seen: list[Upsampler] = [configure(plain(method), p, **named) for p in self.profiles]
        return [p for i, p in enumerate(self.profiles) if seen[i] not in seen[:i]]


def plan_runs(
    plan: Plan, scenes: Sequence[SceneFacts], backend: Backend, version: str
) -> list[RunSpec]:
    """The runs of a plan on a backend (not "auto"), in the order in which they should be run.

    Arms of the method depth are left out for scenes without depth maps, and those that need a scan
    for scenes without one.
    """
    return [
        RunSpec(
            _needed(scene, arm.method), arm, repeat, _training(plan, scene, arm, backend),
            plan.parameters_of(arm.method), version,
        )
        for repeat in range(plan.repeats)
        for scene in scenes
        for strategy in plan.strategies
        for arm in plan.arms(strategy)
        if (arm.method != DEPTH or scene.depth_digest)
        and (scene.cloud_digest or not needs_cloud(arm.method))
    ]  # fmt: skip


def _needed(scene: SceneFacts, method: str) -> SceneFacts:
    """The scene without files that a method does not read, and without what is told before."""
    if method != DEPTH:
        scene = replace(scene, depth="", depth_digest="")
    if not needs_cloud(method):
        scene = replace(scene, cloud="", cloud_digest="")
    return replace(scene, warnings=())


def _training(plan: Plan, scene: SceneFacts, arm: Arm, backend: Backend) -> TrainSettings:
    """The plan's settings, at the size and with the number of Gaussians that this scene has."""
    factor = plan.training.data_factor
    if plan.long_side is not None or factor is None:
        factor = max(1, -(-scene.long_side // (plan.long_side or TRAINED_SIDE)))
    settings = replace(plan.training, backend=backend, data_factor=factor)
    if not arm.budget:
        return settings
    return replace(settings, cap_max=max(2, parse_budget(arm.budget, scene.pixels_at(factor))))


def _budget(given: object) -> str:
    """A budget in the plan's form, so that 20000, "20k" and "20000.0" are the same."""
    text = str(given).strip().lower()
    number = parse_budget(text, pixels=_LARGEST_IMAGE)
    if text.endswith(RHO):
        return f"{float(text.removesuffix(RHO)):g}{RHO}"
    if number < 2:
        raise ParameterError("budgets of at least 2 Gaussians", found=f"{given}", fix=SEE)
    return f"{number}"
