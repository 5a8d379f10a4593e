"""The specification of a run of the benchmark, and its result.

Notation: an *arm* is everything about a run except its scene and its repeat: two runs are *paired*
if those two are equal. Promise: ``RunSpec.key`` depends on everything that determines the result
and on nothing else (not on where the scene is), so that a run in the ledger need never be repeated.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, Self

from splatseed.scores import CurvePoint, EvalResult
from splatseed.train.seeds import most_seeds
from splatseed.train.settings import StrategyName, TrainSettings
from splatseed.upsample import Profile

SFM = "sfm"
"""The method that leaves the cloud of Structure-from-Motion as it is; its ratio is 1."""

ANY_RATIO = 0.0
"""The ratio of methods that choose their number of seeds, and of all if a budget determines it."""

CLOUD = "cloud"
"""The method whose seeds are those of a scene's scan."""

WITH_CLOUD = ("cloud+auto", "cloud+stereo", "cloud+cover")
"""A scan's seeds, and those that another method puts where it has none."""

RunStatus = Literal["pending", "running", "done", "failed"]

DEFAULT = TrainSettings()
SHARED = tuple(
    each.name for each in fields(TrainSettings) if each.name not in {"strategy", "seed", "seeding"}
)
"""Settings that all runs of a plan share; arms and repeats determine the others."""

EARLY = {
    "max_steps", "data_factor", "test_every", "cap_max", "sh_degree", "backend", "opacity_reset",
}  # fmt: skip
"""Settings that every key includes, default or not: older ledgers' keys have only these."""

WHERE = {"scene_path", "depth_path", "cloud_path", "images"}
"""Fields of a specification that say where things are, not what they are."""


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
        parameters: The method's parameters that differ from its profile's.
        repeat: From 0; seeds both upsampling and training.
        training: The settings; the arm gives the strategy, the repeat the seed.
        depth_digest: Fingerprint of the depth maps, for the method depth; empty without.
        version: The package's version.
        scene_path: Where the scene lies; not part of the key.
        depth_path: Where its depth maps lie, if any; not part of the key.
        cloud_digest: Fingerprint of the scan's file, for methods that need it; empty without.
        cloud_path: Where the scan lies, if any; not part of the key.
        images: The folder of photographs within the scene's, such as ``images_4``; empty for the
            one that is found. Not part of the key either: the fingerprint is of its files.
    """

    scene: str
    scene_digest: str
    arm: Arm
    repeat: int
    training: TrainSettings = DEFAULT
    parameters: Mapping[str, Any] = field(default_factory=dict)
    depth_digest: str = ""
    version: str = ""
    scene_path: str = ""
    depth_path: str = ""
    images: str = ""
    cloud_digest: str = ""
    cloud_path: str = ""

    @property
    def key(self) -> str:
        """The fingerprint of everything that determines the result: 32 hexadecimal digits."""
        told = {k: v for k, v in self._flat().items() if k not in WHERE and self._is_told(k, v)}
        if not self.arm.budget:  # later than the ledgers of runs without
            del told["arm"]["budget"]
        if not self.cloud_digest:
            del told["cloud_digest"]
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

    def to_json(self) -> str:
        """As one line of JSON."""
        return json.dumps(self._flat(), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse of ``to_json``; settings that an old ledger lacks have their defaults."""
        values = json.loads(text)
        training = TrainSettings(**{k: values.pop(k) for k in SHARED if k in values})
        return cls(**{**values, "arm": Arm(**values["arm"]), "training": training})

    def _flat(self) -> dict[str, Any]:
        """The fields, with those of ``training`` among them."""
        values = asdict(self)
        training = values.pop("training")
        return {**values, **{name: training[name] for name in SHARED}}

    @staticmethod
    def _is_told(name: str, value: object) -> bool:
        """Whether a field is part of the key: newer settings are not while at their default."""
        return name not in SHARED or name in EARLY or value != getattr(DEFAULT, name)


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
        twin: The key of the run whose training was reused, as it began with the same seeds; empty
            if this run was trained itself.
    """

    scores: EvalResult
    curve: tuple[CurvePoint, ...]
    num_seeds: int
    upsample_seconds: float
    train_seconds: float
    peak_bytes: int | None
    device: str
    peak_gpu_bytes: int | None = None
    twin: str = ""

    @property
    def psnr(self) -> float:
        """Mean over test images of each one's PSNR, dB."""
        return self.scores.psnr

    @property
    def ssim(self) -> float:
        """Mean SSIM."""
        return self.scores.ssim

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS; None where it was not measured."""
        return self.scores.lpips

    @property
    def num_gaussians(self) -> int:
        """Gaussians at the end."""
        return self.scores.num_gaussians or 0

    @property
    def model_bytes(self) -> int:
        """Bytes of their parameters as float32."""
        return self.scores.model_bytes or 0

    @property
    def seconds(self) -> float:
        """Seconds of making the seeds and training from them."""
        return self.upsample_seconds + self.train_seconds

    def to_json(self) -> str:
        """As one line of JSON."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        parts = {"scores": self.scores.to_dict(), "curve": [asdict(each) for each in self.curve]}
        return json.dumps({**own, **parts}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse of ``to_json``, also for versions that stored scores beside the rest."""
        values = json.loads(text)
        scores = EvalResult.from_dict(values.pop("scores", None) or _early_scores(values))
        curve = tuple(CurvePoint(**each) for each in values.pop("curve"))
        known = {each.name for each in fields(cls)}
        return cls(scores, curve, **{k: v for k, v in values.items() if k in known})


def _early_scores(values: Mapping[str, Any]) -> dict[str, Any]:
    """The scores of a result of versions before 0.2, which kept the time to render once for all."""
    seconds = {"seconds": values["render_seconds"]}
    told = {name: values[name] for name in ("num_gaussians", "model_bytes")}
    return {**told, "per_image": [{**each, **seconds} for each in values["per_image"]]}


@dataclass(frozen=True)
class RunRow:
    """A row of the ledger.

    Args:
        spec: The run's specification.
        status: Its status.
        result: Its result; only when done.
        error: Why it failed; only when failed.
        attempts: How often it was started.
        worker: Who has it or had it last: host and process.
        started: When it was last started, seconds since 1970; None before.
        finished: When it ended, likewise.
    """

    spec: RunSpec
    status: RunStatus = "pending"
    result: RunResult | None = None
    error: str = ""
    attempts: int = 0
    worker: str = ""
    started: float | None = None
    finished: float | None = None
