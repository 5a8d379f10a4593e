"""What a run of the benchmark is asked for, and what came of it.

Notation: an *arm* is everything about a run but its scene and its repeat: two runs are *paired*
when those two are equal. Promise: ``RunSpec.key`` depends on all that determines the result and on
nothing else (not on where the scene lies), so that a run that is in the ledger need never be
repeated.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal, Self

from splatseed.train.settings import StrategyName, TrainSettings
from splatseed.upsample import Profile

__all__ = [
    "ANY_RATIO",
    "SFM",
    "SHARED",
    "Arm",
    "CurvePoint",
    "ImageScore",
    "RunResult",
    "RunRow",
    "RunSpec",
    "RunStatus",
]

SFM = "sfm"
"""The method that leaves the cloud of Structure-from-Motion as it is; its ratio is 1."""

ANY_RATIO = 0.0
"""The ratio of methods that make as many seeds as the photographs need."""

RunStatus = Literal["pending", "running", "done", "failed"]

DEFAULT = TrainSettings()
SHARED = tuple(
    each.name for each in fields(TrainSettings) if each.name not in {"strategy", "seed", "seeding"}
)
"""Settings that all runs of a plan share; its arms and repeats decide the others."""

EARLY = {
    "max_steps", "data_factor", "test_every", "cap_max", "sh_degree", "backend", "opacity_reset",
}  # fmt: skip
"""Settings that every key tells, default or not: older ledgers' keys have them, and no others."""

WHERE = {"scene_path", "depth_path", "images"}
"""Fields of a specification that say where things lie, and nothing about what they are."""


@dataclass(frozen=True)
class Arm:
    """How a scene is seeded and trained.

    Args:
        method: ``SFM``, or a key of ``splatseed.METHODS``.
        profile: "default" or "paper".
        ratio: Points in all, per original; ``ANY_RATIO`` where the photographs say it.
        strategy: The densification strategy.
    """

    method: str
    profile: Profile
    ratio: float
    strategy: StrategyName

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
    """One run: everything that determines its result, and where its scene lies.

    Args:
        scene: The scene's name in tables.
        scene_digest: Fingerprint of its points, cameras and image files.
        arm: How it is seeded and trained.
        parameters: The method's parameters that differ from its profile's.
        repeat: From 0; seeds both upsampling and training.
        training: How it is trained; the arm says by which strategy, the repeat by which seed.
        depth_digest: Fingerprint of the depth maps, for the method depth; empty without.
        version: The package's version.
        scene_path: Where the scene lies; not part of the key.
        depth_path: Where its depth maps lie, if any; not part of the key.
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

    @property
    def key(self) -> str:
        """Fingerprint of what determines the result: 32 hexadecimal digits."""
        told = {k: v for k, v in self._flat().items() if k not in WHERE and self._is_told(k, v)}
        text = json.dumps(told, sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def settings(self) -> TrainSettings:
        """How to train, with the arm's strategy and the repeat's seed."""
        return replace(self.training, strategy=self.arm.strategy, seed=self.repeat)

    def to_json(self) -> str:
        """As one line of JSON."""
        return json.dumps(self._flat(), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What ``to_json`` wrote; settings that a ledger is too old to have are at their defaults."""
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
        """Whether a field is part of the key: later settings are not while they change nothing."""
        return name not in SHARED or name in EARLY or value != getattr(DEFAULT, name)


@dataclass(frozen=True)
class ImageScore:
    """One test view's scores: PSNR in dB, SSIM, LPIPS or None."""

    name: str
    psnr: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class CurvePoint:
    """The test views on the way: steps done, seconds of training, mean PSNR in dB, Gaussians."""

    step: int
    seconds: float
    psnr: float
    num_gaussians: int


@dataclass(frozen=True)
class RunResult:
    """What a run gave.

    Args:
        psnr: Mean over test images of each one's PSNR, dB.
        ssim: Mean SSIM.
        lpips: Mean LPIPS; None where it was not measured.
        per_image: One score per test view.
        curve: The test views on the way, in order of steps.
        num_seeds: Points that training began with.
        num_gaussians: Gaussians at the end.
        model_bytes: Bytes of their parameters as float32.
        upsample_seconds: Wall time of making the seeds; 0 for ``SFM``.
        train_seconds: Wall time of the training steps alone.
        render_seconds: Wall time of rendering a test view, on average.
        peak_bytes: Most memory the process held; None where the system does not tell.
        device: Where it was trained, in words.
        peak_gpu_bytes: Most memory that PyTorch held on the GPU; None without one.
    """

    psnr: float
    ssim: float
    lpips: float | None
    per_image: tuple[ImageScore, ...]
    curve: tuple[CurvePoint, ...]
    num_seeds: int
    num_gaussians: int
    model_bytes: int
    upsample_seconds: float
    train_seconds: float
    render_seconds: float
    peak_bytes: int | None
    device: str
    peak_gpu_bytes: int | None = None

    def to_json(self) -> str:
        """As one line of JSON."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """What ``to_json`` wrote."""
        values = json.loads(text)
        images = tuple(ImageScore(**each) for each in values["per_image"])
        curve = tuple(CurvePoint(**each) for each in values["curve"])
        known = {each.name for each in fields(cls)}
        rest = {k: v for k, v in values.items() if k in known - {"per_image", "curve"}}
        return cls(per_image=images, curve=curve, **rest)


@dataclass(frozen=True)
class RunRow:
    """A run as the ledger has it.

    Args:
        spec: What was asked for.
        status: How far it is.
        result: What it gave; only when done.
        error: Why it failed; only when failed.
        attempts: How often it was begun.
        worker: Who has it or had it last: host and process.
        started: When it was last begun, seconds since 1970; None before.
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
