"""A plan: which scenes, which arms, how often, how each run is trained; and the runs that follow.

Notation: an *arm* is everything about a run except its scene and its repeat; two runs are *paired*
if those two are equal. Promise: a plan that exists is valid; its runs are ordered so that all arms
of all scenes have been run once before any is repeated; ``RunSpec.key`` depends on everything that
determines the result and on nothing else (not on where the scene lies).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self, get_args

from splatseed.bench.scenes import SceneFacts
from splatseed.errors import ParameterError
from splatseed.literal import did_you_mean
from splatseed.scores import CurvePoint, EvalResult
from splatseed.seeding.upsampling import RHO, parse_budget
from splatseed.train.seeds import most_seeds
from splatseed.train.settings import Backend, StrategyName, TrainSettings
from splatseed.upsample import METHODS, Profile, Upsampler, chooses_number, configure

SFM = "sfm"
"""The method that leaves the cloud of Structure-from-Motion as it is; its ratio is 1."""
ANY_RATIO = 0.0
"""The ratio of methods that choose their number of seeds, and of all if a budget determines it."""
DEPTH, CLOUD = "depth", "cloud"
"""The methods that need a scene's depth maps, and its scan."""
WITH_CLOUD = ("cloud+auto", "cloud+stereo", "cloud+cover")
"""A scan's seeds, and those that another method puts where it has none."""
DEMO = "demo:"
"""The path of the synthetic room, which is made in the benchmark's folder on demand."""
SEE = "See splatseed bench --help."
SHARED = tuple(
    each.name for each in fields(TrainSettings) if each.name not in {"strategy", "seed", "seeding"}
)
"""Settings that all runs of a plan share; arms and repeats determine the others."""
_WHERE = ("scene_path", "depth_path", "cloud_path", "images")
"""Fields of a specification that say where things are, not what they are."""
_DEFAULT = TrainSettings()
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
    """How a scene is seeded and trained.

    Args:
        method: ``SFM``, a key of ``splatseed.METHODS``, or one of ``WITH_CLOUD``.
        profile: "default" or "paper".
        ratio: Points in all, per original; ``ANY_RATIO`` if photographs or the budget decide.
        strategy: The densification strategy.
        budget: Most Gaussians at the end: a number, or a string such as "0.25rho", per pixel of a
            photograph at training size; empty for no limit.
    """

    method: str
    profile: Profile
    ratio: float
    strategy: StrategyName
    budget: str = ""

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
    """One run: everything that determines its result, and where its scene is.

    Args:
        scene: The scene's name in tables.
        scene_digest: Fingerprint of its points, cameras and image files.
        arm: How it is seeded and trained.
        repeat: From 0; seeds both upsampling and training.
        training: The settings; the arm gives the strategy, the repeat the seed.
        parameters: The method's parameters that differ from its profile's.
        depth_digest: Fingerprint of the depth maps, for the method depth; empty without.
        cloud_digest: Fingerprint of the scan's file, for methods that need it; empty without.
        version: The package's version.
        scene_path: Where the scene lies; not part of the key, like the other paths.
        depth_path: Where its depth maps lie, if any.
        cloud_path: Where the scan lies, if any.
        images: The folder of photographs within the scene's, such as ``images_4``; empty for the
            one that is found. Not part of the key either: the fingerprint is of its files.
    """

    scene: str
    scene_digest: str
    arm: Arm
    repeat: int
    training: TrainSettings = _DEFAULT
    parameters: Mapping[str, Any] = field(default_factory=dict)
    depth_digest: str = ""
    cloud_digest: str = ""
    version: str = ""
    scene_path: str = ""
    depth_path: str = ""
    cloud_path: str = ""
    images: str = ""

    @property
    def key(self) -> str:
        """The fingerprint of everything that determines the result: 32 hexadecimal digits."""
        told = {name: value for name, value in self.to_dict().items() if name not in _WHERE}
        text = json.dumps(told, sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

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

    def to_dict(self) -> dict[str, Any]:
        """As plain values; of the settings, those that differ from their defaults."""
        settings = vars(self.training).items()
        told = {name: value for name, value in settings if value != getattr(_DEFAULT, name)}
        return {**asdict(self), "parameters": dict(self.parameters), "training": told}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of ``to_dict``."""
        parts = {"arm": Arm(**values["arm"]), "training": TrainSettings(**values["training"])}
        return cls(**{**values, **parts})


@dataclass(frozen=True)
class RunResult:
    """The result of a run.

    Args:
        scores: Scores of the test views at the end.
        curve: Scores of the test views during training, in order of steps.
        num_seeds: Points that training began with.
        upsample_seconds: Wall time of making the seeds, thinning included; 0 for plain ``SFM``.
        train_seconds: Wall time of the training steps alone.
        peak_bytes: Peak memory of the process; None where the system does not tell.
        device: Where it was trained, in words.
        peak_gpu_bytes: Peak memory of PyTorch on the GPU; None without one.
        wall_seconds: Wall time of the whole run, with reading, tests and pictures.
    """

    scores: EvalResult
    curve: tuple[CurvePoint, ...]
    num_seeds: int
    upsample_seconds: float
    train_seconds: float
    peak_bytes: int | None
    device: str
    peak_gpu_bytes: int | None = None
    wall_seconds: float = 0.0

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
        _check_choices("methods", self.methods, (SFM, *METHODS, *WITH_CLOUD))
        _check_choices("strategies", self.strategies, get_args(StrategyName))
        _check_choices("profiles", self.profiles, get_args(Profile))
        _check_distinct("ratios", self.ratios)
        _check_distinct("budgets", self.budgets)
        _check_distinct("scenes", [each.label for each in self.scenes])
        training, long_side = self.training, self.long_side
        for fits, expected, found in (
            (self.ratios or self.budgets, "ratios of at least one", "none"),
            (all(1 < each < math.inf for each in self.ratios),
             "ratios above 1 (points in all, per original)", self.ratios),
            (not self.budgets or training.cap_max is None, "budgets or cap_max", "both"),
            (long_side is None or long_side >= _LEAST_SIDE,
             f"long_side of {_LEAST_SIDE} or more", long_side),
            (long_side is None or training.data_factor == 1, "long_side or data_factor", "both"),
            (self.repeats >= 1, "repeats of 1 or more", self.repeats),
        ):  # fmt: skip
            if not fits:
                raise ParameterError(expected, found=f"{found}", fix=SEE)
        for method in self.parameters:
            _check_choices("parameters", (method,), tuple(METHODS))
            configure(method, **self.parameters[method])

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
                    any_ratio = chooses_number(plain(method)) or not self.ratios
                    arms += [
                        Arm(method, profile, ratio, strategy, budget)
                        for profile in self._profiles_of(method)
                        for ratio in ((ANY_RATIO,) if any_ratio else self.ratios)
                    ]
        return tuple(arms)

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
        for scene in scenes
        for arm in _arms_on(plan, scene)
    ]


def _arms_on(plan: Plan, scene: SceneFacts) -> Iterator[Arm]:
    for strategy in plan.strategies:
        for arm in plan.arms(strategy):
            has_maps = arm.method != DEPTH or scene.depth_digest
            if has_maps and (scene.cloud_digest or not needs_cloud(arm.method)):
                yield arm


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
    """A budget in the plan's form, so that 20000, "20k" and "20000.0" are the same."""
    text = str(given).strip().lower()
    number = parse_budget(text, pixels=_LARGEST_IMAGE)
    if text.endswith(RHO):
        return f"{float(text.removesuffix(RHO)):g}{RHO}"
    if number < 2:
        raise ParameterError("budgets of at least 2 Gaussians", found=f"{given}", fix=SEE)
    return f"{number}"


def _check_choices(name: str, given: Sequence[str], known: Sequence[str]) -> None:
    _check_distinct(name, given)
    if not given:
        raise ParameterError(f"{name} of at least one", found="none", fix=SEE)
    for each in given:
        if each not in known:
            see = did_you_mean(each, known) or SEE
            raise ParameterError(f"{name} among {', '.join(known)}", found=each, fix=see.strip())


def _check_distinct(name: str, given: Sequence[object]) -> None:
    twice = next((each for i, each in enumerate(given) if each in given[:i]), None)
    if twice is not None:
        fix = "Give names to scenes in a plan (see --dry-run)." if name == "scenes" else "Drop one."
        raise ParameterError(f"{name} that differ", found=f"{twice} twice", fix=fix)


_GROWTH = 3.0
"""Gaussians at the end of a run per seed, with densification and without a cap: a guess."""
_LIKELY_RATIO = 3.0
"""Seeds per original, for methods that look at photographs."""
_TESTS = 21
"""How often the test views are rendered: during training, and at the end."""


def expected_gaussians(spec: RunSpec, scene: SceneFacts) -> tuple[float, float]:
    """Gaussians at the start and at the end of a run, as far as is known before it.

    Args:
        spec: The run.
        scene: Facts about its scene.
    """
    cap = spec.settings.cap or math.inf
    made = scene.num_points * (spec.arm.ratio or _LIKELY_RATIO)
    seeds = min(made, spec.most_seeds or cap)
    grown = 1.0 if spec.settings.densification == "none" else _GROWTH
    return seeds, min(seeds * grown, cap)


def rule_of_thumb(spec: RunSpec, scene: SceneFacts, threads: int) -> float:
    """Seconds of a run by a rough model, which can be several times off.

    A step takes a + b G + c P seconds for G Gaussians and P pixels: measured on 2 cores with
    AVX-512 on three scenes, and on one GPU with 3 million Gaussians.

    Args:
        spec: The run.
        scene: Facts about its scene.
        threads: Threads of the run, on the CPU.
    """
    on_gpu = spec.training.backend == "cuda"
    a, b, c, around = (8e-3, 5e-9, 2e-9, 20.0) if on_gpu else (6e-3, 0.18e-6, 0.09e-6, 6.0)
    gaussians = sum(expected_gaussians(spec, scene)) / 2
    step = a + b * gaussians + c * scene.pixels_at(spec.training.data_factor)
    renders = 0.3 * _TESTS * scene.num_images / spec.training.test_every
    method = plain(spec.arm.method)
    compares = spec.settings.densification == "grow" or (method != SFM and chooses_number(method))
    compared = 0.8 * scene.num_images if compares else 0.0
    slower = 1.0 if on_gpu else 2 / threads
    return around + slower * (step * (spec.training.max_steps + renders) + compared)
