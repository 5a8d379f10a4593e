"""Scores of test views, during a run and at its end.

PSNR is in dB, SSIM, FLIP and LPIPS have no unit, seconds are wall time. Means are over images.
Scores that were not measured are None.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Self

NOT_REQUESTED = "not asked for"


@dataclass(frozen=True)
class ViewScore:
    """One view's scores."""

    name: str  # the image's, in its scene
    psnr: float  # dB, infinite for equal images
    ssim: float  # 1 for equal images
    lpips: float | None  # 0 for equal images; None if not measured
    seconds: float  # time to render it
    covisible_psnr: float | None = None  # over pixels that two training views see; None if unknown
    covisible_share: float | None = None  # of these pixels; likewise
    flip: float | None = None  # 0 for equal images; None in results of versions without it
    cc_psnr: float | None = None  # PSNR after correcting the render's colours, dB; likewise


@dataclass(frozen=True)
class EvalResult:
    """Scores of test views, and their means; NaN or None without test views."""

    per_image: tuple[ViewScore, ...]  # in the views' order; none if nothing was held out
    lpips_net: str | None = None  # None if not measured
    lpips_reason: str = NOT_REQUESTED  # why LPIPS was not measured; empty if it was
    num_gaussians: int | None = None  # rendered; None if the renderer does not tell
    model_bytes: int | None = None  # of their parameters as float32; None likewise

    @property
    def psnr(self) -> float:
        """Mean PSNR of the images in dB (not the PSNR of the mean error)."""
        return _mean(score.psnr for score in self.per_image)

    @property
    def ssim(self) -> float:
        """Mean SSIM."""
        return _mean(score.ssim for score in self.per_image)

    @property
    def cc_psnr(self) -> float | None:
        """Mean colour-corrected PSNR in dB; None if not measured."""
        return _mean_known(score.cc_psnr for score in self.per_image)

    @property
    def flip(self) -> float | None:
        """Mean FLIP; None if not measured."""
        return _mean_known(score.flip for score in self.per_image)

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS; None if not measured."""
        return _mean_known(score.lpips for score in self.per_image)

    @property
    def covisible_psnr(self) -> float | None:
        """Mean PSNR over co-visible pixels, of images that have any; None if not measured."""
        return _mean_known(score.covisible_psnr for score in self.per_image)

    @property
    def covisible_share(self) -> float | None:
        """Mean share of co-visible pixels; None if not measured."""
        return _mean_known(score.covisible_share for score in self.per_image)

    @property
    def render_seconds(self) -> float:
        """Mean time to render a view."""
        return _mean(score.seconds for score in self.per_image)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinity and NaN become None."""
        names = ("psnr", "cc_psnr", "ssim", "flip", "lpips", "covisible_psnr", "covisible_share")
        means = (*names, "render_seconds")
        return {
            **_finite({name: getattr(self, name) for name in means}),
            **{key: value for key, value in asdict(self).items() if key != "per_image"},
            "per_image": [_finite(asdict(score)) for score in self.per_image],
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Invert ``to_dict``; means are recomputed, unknown keys ignored."""
        views = [
            ViewScore(**{**each, "psnr": math.inf if each["psnr"] is None else each["psnr"]})
            for each in values["per_image"]
        ]
        own = {each.name: values[each.name] for each in fields(cls) if each.name in values}
        return cls(**{**own, "per_image": tuple(views)})


@dataclass(frozen=True)
class CurvePoint:
    """Scores of the test views during training."""

    step: int  # steps done
    seconds: float  # of training so far
    psnr: float  # mean, dB
    num_gaussians: int
    ssim: float | None = None  # mean; None in results of versions that did not measure it


@dataclass(frozen=True)
class TrainingResult:
    """The result of a training run."""

    scores: EvalResult  # of the test views at the end
    curve: tuple[CurvePoint, ...]  # of the test views during training, in order of steps
    steps: int
    train_seconds: float  # of the steps, and of the depth maps for growth
    num_seeds: int  # points at the start
    held_by_memory_at: int | None = None  # Gaussians at which memory limited growth

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``metrics.json``."""
        others = {key: getattr(self, key) for key in ("steps", "train_seconds", "num_seeds")}
        tests = [_finite(asdict(point)) for point in self.curve]
        held = {"held_by_memory_at": self.held_by_memory_at}
        return {**self.scores.to_dict(), **others, **held, "tests": tests}


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    if not listed:
        return math.nan
    return math.fsum(listed) / len(listed) if all(map(math.isfinite, listed)) else sum(listed)


def _mean_known(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _mean(known) if known else None


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in values.items()
    }
