"""EvalResult: how well a set of test views was rendered, as numbers that can be written down.

Notation: PSNR in dB, SSIM and LPIPS without unit; seconds are wall time. Promise: means are means
over images of per-image values; what was not measured is None, with the reason beside it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["EvalResult", "ViewScore"]

NOT_ASKED = "not asked for"


@dataclass(frozen=True)
class ViewScore:
    """One view's scores.

    Args:
        name: The image's name in its scene.
        psnr: Peak signal-to-noise ratio in dB; higher is better, infinite for equal images.
        ssim: Structural similarity, 1 for equal images.
        lpips: Perceptual distance, 0 for equal images; None where it was not measured.
        seconds: Time to render it.
    """

    name: str
    psnr: float
    ssim: float
    lpips: float | None
    seconds: float


@dataclass(frozen=True)
class EvalResult:
    """Scores over test views.

    Args:
        per_image: One score per view, in the views' order; at least one.
        lpips_net: The network that LPIPS was measured with; None where it was not measured.
        lpips_reason: Why LPIPS was not measured; empty where it was.
        num_gaussians: How many Gaussians were rendered; None where the renderer is a black box.
        model_bytes: Bytes of their parameters as float32; None likewise.
    """

    per_image: tuple[ViewScore, ...]
    lpips_net: str | None = None
    lpips_reason: str = NOT_ASKED
    num_gaussians: int | None = None
    model_bytes: int | None = None

    @property
    def psnr(self) -> float:
        """Mean of the images' PSNR in dB, not the PSNR of the mean error."""
        return _mean(score.psnr for score in self.per_image)

    @property
    def ssim(self) -> float:
        """Mean SSIM."""
        return _mean(score.ssim for score in self.per_image)

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS; None where it was not measured."""
        values = [score.lpips for score in self.per_image if score.lpips is not None]
        return _mean(values) if values else None

    @property
    def render_seconds(self) -> float:
        """Mean time to render a view."""
        return _mean(score.seconds for score in self.per_image)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values; a number that JSON does not know (infinite) is None."""
        means = {
            "psnr": self.psnr,
            "ssim": self.ssim,
            "lpips": self.lpips,
            "render_seconds": self.render_seconds,
        }
        return {
            **_finite(means),
            **{key: value for key, value in asdict(self).items() if key != "per_image"},
            "per_image": [_finite(asdict(score)) for score in self.per_image],
        }

    def to_json(self) -> str:
        """The result as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"


def _mean(values: Iterable[float] | Sequence[float]) -> float:
    listed = list(values)
    return math.fsum(listed) / len(listed) if all(map(math.isfinite, listed)) else sum(listed)


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in values.items()
    }
