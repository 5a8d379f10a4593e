"""Plans of a benchmark, and the runs that they unroll to.

An *arm* is everything about a run except its scene and its repeat. A ``Plan`` validates itself. Its
runs are ordered by repeat, so that every arm runs once on every scene before any runs again.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self, get_args

from splatseed.bench.scenes import PlannedScene, SceneFacts
from splatseed.bench.versions import method_version, splatseed_version
from splatseed.errors import ParameterError
from splatseed.methods import (
    METHODS,
    OWN_METHOD,
    Profile,
    Upsampler,
    absolute_place,
    chooses_number,
    configure,
    method_label,
)
from splatseed.photos.sizes import TRAINED_SIDE
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scores import CurvePoint, EvalResult
from splatseed.seeding.budget import RHO, parse_budget
from splatseed.text import did_you_mean
from splatseed.training.duration import GAUSSIANS_PER_SEED, step_seconds
from splatseed.training.settings import Backend, StrategyName, TrainSettings
from splatseed.training.traits import STRATEGIES

SFM = "sfm"
"""The baseline: the unchanged points of Structure-from-Motion, at ratio 1."""
ANY_RATIO = 0.0
"""The ratio of an arm whose number of seeds the method or the budget determines."""
DEPTH, CLOUD = "depth", "cloud"
"""The methods that need the depth maps and the scan of a scene."""
WITH_CLOUD = ("cloud+auto", "cloud+stereo", "cloud+cover")
"""Methods that add the seeds of another method where the scan has gaps."""
HELP = "See splatseed bench --help."
SHARED = tuple(
    setting.name
    for setting in fields(TrainSettings)
    if setting.name not in {"strategy", "seed", "seeding", "region", "start"}
)
"""Training settings that all runs of a plan share; the arm and the repeat set the others."""
_SCENE_KEY = ("name", "digest", "depth_digest", "cloud_digest")
"""Fields of ``SceneFacts`` that enter a run's key; paths and sizes do not."""
_LISTS = ("methods", "strategies", "profiles", "ratios", "budgets")
_DEFAULT = TrainSettings()
PER_POINT, _OR = "x", " or "
"""The unit of a budget per original point; what stands between two budgets, of which the larger
counts."""
_FAIR_RHO = 0.25
"""Gaussians per pixel that ``fair_budget`` allows at least."""
_MAX_IMAGE_PIXELS = 1e9
"""A budget per pixel is invalid if it allows no Gaussian in an image of this size."""
_MIN_SIDE = 11
"""Minimum side of a photograph in pixels: the window of SSIM."""


@dataclass(frozen=True)
class _CostModel:
    """Constants of the rough estimates of ``RunSpec.gaussians`` and ``RunSpec.seconds``."""

    ratio: float = 3.0
    """Seeds per original of methods that choose their number."""
    added: float = 3e5
    """Gaussians that 3DGS's own schedule adds in a run of any length: fern's 6,000 SfM points grew
    to 265,000 after 60 steps at 75 x 100 pixels, to 570,000 in 1,750 steps at 300 x 400."""
    added_per_pixel: float = 3.0
    """The same, per pixel of a photograph."""
    tests: int = 21
    """Evaluations of the test views, the final one included."""
    render_share: float = 0.3
    """Time of a render, as a share of a training step."""
    startup_seconds: tuple[float, float] = (6.0, 20.0)
    """Time of a run outside of training, on a CPU and on a GPU."""
    stereo_seconds: float = 0.8
    """Time to match a photograph with its neighbours on two threads."""


_COST = _CostModel()


def seeding_method(method: str) -> str:
    """Strip the prefix of a method that is combined with a scan: ``cloud+auto`` gives ``auto``."""
    return method.removeprefix(f"{CLOUD}+")


def needs_cloud(method: str) -> bool:
    """Whether a method needs the scan of a scene."""
    return method == CLOUD or method in WITH_CLOUD


@dataclass(frozen=True)
class Arm:
    """How a scene is seeded and trained."""

    method: str
    """``SFM``, a key of ``splatseed.METHODS``, or one of ``WITH_CLOUD``."""
    profile: Profile
    ratio: float
    """Total points per original; ``ANY_RATIO`` if the method or the budget determines them."""
    strategy: StrategyName
    budget: str = ""
    """One of ``Plan.budgets``; empty for no limit."""

    def __post_init__(self) -> None:
        # 8 and 8.0 must give the same key.
        object.__setattr__(self, "ratio", float(self.ratio))

    @property
    def label(self) -> str:
        """A short name without the strategy, such as ``mls 8x`` or ``mls 8x (paper)``."""
        if self.method == SFM:
            return SFM
        ratio = f" {self.ratio:g}x" if self.ratio else ""
        return method_label(self.method) + ratio + " (paper)" * (self.profile == "paper")


@dataclass(frozen=True)
class RunSpec:
    """Everything that determines the result of one run, and the paths of its scene."""

    scene: SceneFacts
    """Has depth maps or a scan only if the method needs them."""
    arm: Arm
    repeat: int
    """From 0; the random seed of upsampling and of training."""
    training: TrainSettings = _DEFAULT
    """The shared settings; ``settings`` adds the strategy and the seed."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """The method's parameters that differ from its profile's."""
    version: str = ""
    """That of splatseed, as of ``splatseed_version``."""
    method_version: str = ""
    """That of the method if it is not splatseed's, as of ``method_version``."""

    @property
    def key(self) -> str:
        """The fingerprint of everything that determines the result."""
        values = {**self.to_dict(), "scene": [getattr(self.scene, name) for name in _SCENE_KEY]}
        values["arm"]["method"] = method_label(self.arm.method)  # its version covers its file
        text = json.dumps(values, sort_keys=True, separators=(",", ":"))
        return fingerprint(text.encode())

    @property
    def settings(self) -> TrainSettings:
        """The training settings, with the strategy of the arm and the seed of the repeat."""
        return replace(self.training, strategy=self.arm.strategy, seed=self.repeat)

    @property
    def max_seeds(self) -> int | None:
        """The number to which a budget thins the seeds; None without a budget."""
        if not self.arm.budget or self.training.cap_max is None:
            return None
        return self.settings.max_seeds(self.training.cap_max)

    @property
    def gaussians(self) -> tuple[float, float]:
        """Estimates of the number of Gaussians at the start and at the end."""
        cap = self.settings.cap or math.inf
        num_seeds = self.scene.num_points * (self.arm.ratio or _COST.ratio)
        seeds = min(num_seeds, self.max_seeds or cap)
        grown = seeds * GAUSSIANS_PER_SEED if self.settings.traits.number_grows else seeds
        if self.arm.strategy == "default-3dgs":
            pixels = self.scene.pixels_at(self.training.factor)
            grown = seeds + _COST.added + _COST.added_per_pixel * pixels
        return seeds, min(grown, cap)

    def seconds(self, threads: int) -> float:
        """Estimate the wall time on this many threads; it can be several times off."""
        on_gpu = self.training.backend == "cuda"
        pixels = self.scene.pixels_at(self.training.factor)
        step = step_seconds("cuda" if on_gpu else "cpu", sum(self.gaussians) / 2, pixels)
        renders = _COST.tests * self.scene.num_images / self.training.test_every
        method = seeding_method(self.arm.method)
        uses_stereo = method != SFM and chooses_number(method)
        uses_stereo |= self.settings.traits.uses_stereo
        stereo = _COST.stereo_seconds * self.scene.num_images * uses_stereo
        training = step * (self.training.max_steps + _COST.render_share * renders)
        slowdown = 1.0 if on_gpu else 2 / threads
        return _COST.startup_seconds[on_gpu] + slowdown * (training + stereo)

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON values; settings with default values are omitted."""
        settings = vars(self.training).items()
        changed = {name: value for name, value in settings if value != getattr(_DEFAULT, name)}
        values = {**asdict(self), "parameters": dict(self.parameters), "training": changed}
        if not self.method_version:  # as in benchmarks without it, which keep their keys
            del values["method_version"]
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of ``to_dict``."""
        known = {key: value for key, value in values["scene"].items() if key != "warnings"}
        scene = SceneFacts(**known)  # older benchmarks have empty warnings
        parts = {"arm": Arm(**values["arm"]), "training": TrainSettings(**values["training"])}
        return cls(**{**values, "scene": scene, **parts})


@dataclass(frozen=True)
class RunResult:
    """The final ``scores`` of a run, its ``curve`` of test scores, and its costs."""

    scores: EvalResult
    curve: tuple[CurvePoint, ...]
    num_seeds: int
    """Points from which training started."""
    upsample_seconds: float
    """Wall time of seeding and thinning; 0 for ``SFM`` without a budget."""
    train_seconds: float
    """Wall time of the training steps alone."""
    peak_bytes: int | None
    """Peak memory of the process; None where the system does not report it."""
    device: str
    peak_gpu_bytes: int | None = None
    wall_seconds: float = 0.0
    """Wall time of the run, including reading, tests and pictures."""

    @property
    def psnr(self) -> float:
        """PSNR in dB, mean over the test images."""
        return self.scores.psnr

    @property
    def num_gaussians(self) -> int:
        """Final number of Gaussians."""
        return self.scores.num_gaussians or 0

    @property
    def seconds(self) -> float:
        """Time of seeding and training."""
        return self.upsample_seconds + self.train_seconds

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON values."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**values, "scores": self.scores.to_dict(), "curve": list(map(asdict, self.curve))}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of ``to_dict``."""
        scores = EvalResult.from_dict(values["scores"])
        curve = tuple(CurvePoint(**point) for point in values["curve"])
        return cls(**{**values, "scores": scores, "curve": curve})


@dataclass(frozen=True)
class Plan:
    """The scenes, arms and settings of a benchmark.

    Raises:
        ParameterError: A value is out of its range, or given twice.
    """

    scenes: tuple[PlannedScene, ...] = ()
    methods: tuple[str, ...] = (SFM, "linear", "mls")
    """Seeding methods. ``sfm``, the baseline, adds no points. ``cloud+auto`` takes the points of a
    scan, and fills its gaps by ``auto``. ``my_method.py:Jitter`` is in a file."""
    ratios: tuple[float, ...] = (8.0,)
    """Total points per original; empty if budgets determine the number."""
    budgets: tuple[str, ...] = ()
    """Maximum final Gaussians, equal for all arms: a number, "0.25rho" for 0.25 per pixel of a
    photograph at training size, "12x" for 12 per original point, or the larger of both, "0.25rho or
    12x". Seeds are thinned to the budget, or for strategies that add Gaussians to the share of it
    at which they start."""
    strategies: tuple[StrategyName, ...] = ("default",)
    """Densification strategies."""
    uncapped: tuple[StrategyName, ...] = ()
    """Strategies to which budgets do not apply."""
    profiles: tuple[Profile, ...] = ("default",)
    """Parameter sets of the methods: improved (``default``), or as in the paper."""
    repeats: int = 3
    """Number of repeats, with random seeds 0, 1, ..."""
    training: TrainSettings = _DEFAULT
    """Training settings; strategy and seed are set per run."""
    long_side: int | None = None
    """Maximum longer side of the photographs in pixels; sets a whole data factor per scene."""
    keep_models: bool = False
    """Whether to keep the trained Gaussians."""
    lpips: bool = False
    """Whether LPIPS is required; otherwise it is measured only if its weights are found."""
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Parameters by method that differ from the profile."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "ratios", tuple(float(ratio) for ratio in self.ratios))
        object.__setattr__(self, "budgets", tuple(map(_budget, self.budgets)))
        placed = tuple(absolute_place(method, Path()) for method in self.methods)
        object.__setattr__(self, "methods", placed)
        by_method = {absolute_place(name, Path()): v for name, v in self.parameters.items()}
        object.__setattr__(self, "parameters", by_method)
        names = dict.fromkeys((*METHODS, *(m for m in (*placed, *by_method) if m in METHODS)))
        known = {"methods": (SFM, *names, *WITH_CLOUD), "strategies": get_args(StrategyName),
                 "uncapped": get_args(StrategyName), "profiles": get_args(Profile),
                 "parameters": tuple(names)}  # fmt: skip
        for name, choices in known.items():
            for value in getattr(self, name):
                if value not in choices:
                    other = OWN_METHOD if name in {"methods", "parameters"} else HELP
                    fix = did_you_mean(value, choices).strip() or other
                    raise ParameterError(f"{name} among {', '.join(choices)}", found=value, fix=fix)
        lists: dict[str, Any] = {name: getattr(self, name) for name in _LISTS}
        for name, given in {**lists, "scenes": [scene.label for scene in self.scenes]}.items():
            for value, count in Counter(given).items():
                if count > 1:
                    fix = "Drop one, or name the scenes in a plan."
                    raise ParameterError(f"different {name}", found=f"{value} twice", fix=fix)
        training, long_side = self.training, self.long_side
        for valid, expected, found in (
            *((lists[name], f"at least one of {name}", "none") for name in _LISTS[:3]),
            (self.ratios or (self.budgets and not self.uncapped), "at least one of ratios", "none"),
            (all(1 < ratio < math.inf for ratio in self.ratios),
             "ratios above 1 (total points per original)", self.ratios),
            (not self.budgets or training.cap_max is None, "budgets or cap_max", "both"),
            (long_side is None or long_side >= _MIN_SIDE,
             f"long_side of {_MIN_SIDE} or more", long_side),
            (long_side is None or training.factor == 1, "long_side or data_factor", "both"),
            (training.test_every, "test views to compare by (test_every of 2 or more)", "none"),
            (self.repeats >= 1, "repeats of 1 or more", self.repeats),
        ):  # fmt: skip
            if not valid:
                raise ParameterError(expected, found=f"{found}", fix=HELP)
        for method, parameters in self.parameters.items():
            configure(method, **parameters)

    def parameters_of(self, method: str) -> dict[str, Any]:
        """Parameters that differ from the profile; those of a scan start with ``cloud.``."""
        scan = self._own_parameters(CLOUD) if method in WITH_CLOUD else {}
        prefixed = {f"{CLOUD}.{name}": value for name, value in scan.items()}
        return {} if method == SFM else self._own_parameters(method) | prefixed

    def _own_parameters(self, method: str) -> dict[str, Any]:
        """The parameters of a method; ``test_every`` hides the test photographs from it."""
        name = seeding_method(method)
        uses_photos = hasattr(METHODS[name], "test_every")
        split = {"test_every": self.training.test_every} if uses_photos else {}
        return {**split, **self.parameters.get(name, {})}

    def arms(self, strategy: StrategyName) -> tuple[Arm, ...]:
        """List the arms of a strategy: for each budget, the baseline first.

        A method whose profiles are equal has one arm, of the first profile. A method that chooses
        its number of seeds has no ratio.
        """
        arms = []
        for budget in (() if strategy in self.uncapped else self.budgets) or ("",):
            if SFM in self.methods:
                arms.append(Arm(SFM, "default", 1, strategy, budget))
            for method in (name for name in self.methods if name != SFM):
                ratios = () if chooses_number(seeding_method(method)) else self.ratios
                arms += [
                    Arm(method, profile, ratio, strategy, budget)
                    for profile in self._profiles_of(method)
                    for ratio in ratios or (ANY_RATIO,)
                ]
        return tuple(arms)

    def _profiles_of(self, method: str) -> list[Profile]:
        named = self._own_parameters(method)
        seen: list[Upsampler] = [
            configure(seeding_method(method), p, **named) for p in self.profiles
        ]
        return [p for i, p in enumerate(self.profiles) if seen[i] not in seen[:i]]


def plan_runs(plan: Plan, scenes: Sequence[SceneFacts], backend: Backend) -> list[RunSpec]:
    """Unroll a plan to its runs with the present code, in the order in which to run them.

    Scenes without depth maps or a scan get no runs of methods that need them. ``backend`` is not
    "auto".
    """
    versions = {method: method_version(seeding_method(method)) for method in plan.methods}
    return [
        RunSpec(
            _needed(scene, arm.method), arm, repeat, _training(plan, scene, arm, backend),
            plan.parameters_of(arm.method), splatseed_version(), versions[arm.method],
        )
        for repeat in range(plan.repeats)
        for scene in scenes
        for strategy in plan.strategies
        for arm in plan.arms(strategy)
        if (arm.method != DEPTH or scene.depth_digest)
        and (scene.cloud_digest or not needs_cloud(arm.method))
    ]  # fmt: skip


def _needed(scene: SceneFacts, method: str) -> SceneFacts:
    """Drop the files that a method does not read."""
    if method != DEPTH:
        scene = replace(scene, depth="", depth_digest="")
    if not needs_cloud(method):
        scene = replace(scene, cloud="", cloud_digest="")
    return scene


def _training(plan: Plan, scene: SceneFacts, arm: Arm, backend: Backend) -> TrainSettings:
    """The settings of the plan, with the data factor and the budget for this scene."""
    factor = plan.training.data_factor
    if plan.long_side is not None or factor is None:
        factor = max(1, -(-scene.long_side // (plan.long_side or TRAINED_SIDE)))
    settings = replace(plan.training, backend=backend, data_factor=factor)
    if not arm.budget:
        return settings
    pixels, limits = scene.pixels_at(factor), list[int]()
    for part in arm.budget.split(_OR):
        per_point = part.endswith(PER_POINT)
        text = part.removesuffix(PER_POINT) + RHO if per_point else part
        limits.append(parse_budget(text, scene.num_points if per_point else pixels))
    return replace(settings, cap_max=max(2, *limits))


def _budget(given: object) -> str:
    """Normalise a budget, so that 20000, "20k" and "20000.0" are equal."""
    parts = list[str]()
    for part in str(given).strip().lower().split(_OR):
        text = part.strip()
        unit = next((unit for unit in (RHO, PER_POINT) if text.endswith(unit)), "")
        try:
            float(text.removesuffix(unit))
        except ValueError:  # the error shows the text as given
            unit = ""
        text = text.removesuffix(unit)
        number = parse_budget(text + RHO * bool(unit), pixels=_MAX_IMAGE_PIXELS)
        if number < 2:
            raise ParameterError("budgets of at least 2 Gaussians", found=f"{given}", fix=HELP)
        parts.append(f"{float(text):g}{unit}" if unit else f"{number}")
    return _OR.join(parts)


def fair_budget(ratios: Sequence[float]) -> str:
    """The budget that is equal for all arms, and thins none of the seeds that ratios ask for.

    It also allows ``_FAIR_RHO``, as few points would else make a coarse model.
    """
    seeds = max(ratios, default=1.0) / min(each.seed_share for each in STRATEGIES.values())
    return f"{_FAIR_RHO:g}{RHO}{_OR}{math.ceil(seeds)}{PER_POINT}"


def describe_budget(budget: str) -> str:
    """Describe a normalised budget: "0.25 per pixel of a photograph in training"."""
    parts = list[str]()
    for part in budget.split(_OR):
        if part.endswith(RHO):
            parts.append(f"{part.removesuffix(RHO)} per pixel of a photograph in training")
        elif part.endswith(PER_POINT):
            parts.append(f"{part.removesuffix(PER_POINT)} per point of the scene")
        else:
            parts.append(f"{int(part):,}")
    return " or ".join(parts) + " (the larger)" * (len(parts) > 1)
