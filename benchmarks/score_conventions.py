"""What the conventions of scores are worth: other trainers' formulas on our pictures.

Each function below is typed from the script that its docstring names, as it was on the date given;
render x and photograph y are float [H, W, 3] in about [0, 1]. The table shows the mean over the
test views of a run and its difference from ours.

    python -m benchmarks.score_conventions RUN ...
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from jaxtyping import Float
from scipy.ndimage import correlate1d
from torch import Tensor

from benchmarks.common.markdown import table
from splatseed.errors import MissingDependencyError, SceneNotFoundError
from splatseed.splat.lpips import Lpips, load_lpips
from splatseed.splat.metrics import mirrored_ssim, psnr
from splatseed.splat.photographs import photograph_tensor
from splatseed.training.evaluation import Evaluation

__all__: list[str] = []

Image = Float[Tensor, "H W 3"]
Score = Callable[[Image, Image], float]
SIGMA = 1.5


@dataclass(frozen=True)
class Options:
    """Score the test views of runs by the formulas of several trainers."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of finished runs."""


def rounded(image: Image) -> Image:
    """Round to 8 bits as torchvision's ``save_image`` does."""
    return (image * 255 + 0.5).clamp(0, 255).to(torch.uint8).to(torch.float32) / 255


def plain_psnr(x: Image, y: Image) -> float:
    """PSNR of images that are not clamped."""
    return -10 * math.log10(float((x - y).square().mean(dtype=torch.float64)))


def gaussian(offsets: np.ndarray, sigma: float = SIGMA) -> np.ndarray:
    """Gaussian weights of sum 1."""
    weights = np.exp(-(offsets**2) / (2 * sigma**2))
    return np.asarray(weights / weights.sum())


CENTERED = gaussian(np.arange(-5.0, 6.0))
NARROW = gaussian(np.arange(-5.0, 6.0), 2 / 3)
"""LichtFeld Studio's: 1 / 2 * sigma * sigma is there the factor of the squared distance."""
OFF_CENTRE = gaussian(np.floor(np.arange(-11.0, 0.0) / 2))
"""OpenSplat's: floor((i - 11) / 2) is there the distance, for i from 0 to 10."""


def ssim(x: Image, y: Image, window: np.ndarray, *, inside: bool = False) -> float:
    """Mean SSIM of RGB with zeros beyond the edges, or of the windows inside the images alone."""

    def mean(image: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            image = correlate1d(image, window, axis, mode="constant")
        return image[5:-5, 5:-5] if inside else image

    a, b = (image.double().numpy() for image in (x, y))
    mu_a, mu_b, aa, bb, ab = (mean(each) for each in (a, b, a * a, b * b, a * b))
    c1, c2 = 0.01**2, 0.03**2
    top = (2 * mu_a * mu_b + c1) * (2 * (ab - mu_a * mu_b) + c2)
    bottom = (mu_a**2 + mu_b**2 + c1) * (aa - mu_a**2 + bb - mu_b**2 + c2)
    return float((top / bottom).mean())


PSNRS: dict[str, Score] = {
    "ours, gsplat, nerfstudio, LichtFeld Studio: clamped": psnr,
    "graphdeco: both rounded to 8 bits": lambda x, y: psnr(rounded(x), rounded(y)),
    "Brush: rounded, not clamped": lambda x, y: plain_psnr((x * 255).round() / 255, y),
    "one mean squared error over all views": psnr,
}
SSIMS: dict[str, Score] = {
    "ours, gsplat: mirrored edges": mirrored_ssim,
    "nerfstudio: no window beyond the edges": lambda x, y: ssim(
        x.clamp(0, 1), y, CENTERED, inside=True
    ),
    "graphdeco: zeros beyond the edges, 8 bits": lambda x, y: ssim(
        rounded(x), rounded(y), CENTERED
    ),
    "Brush: zeros beyond the edges, 8 bits, not clamped": lambda x, y: ssim(
        (x * 255).round() / 255, y, CENTERED
    ),
    "LichtFeld Studio: a window of sigma 0.67": lambda x, y: ssim(x.clamp(0, 1), y, NARROW),
    "OpenSplat's loss: a window off centre": lambda x, y: ssim(x, y, OFF_CENTRE),
}


def lpips_scores(lpips: Lpips) -> dict[str, Score]:
    """Return LPIPS on images in -1 to 1, and as if those in 0 to 1 were in that range."""

    def unscaled(x: Image, y: Image) -> float:
        return lpips(*((rounded(image) + 1) / 2 for image in (x, y)))

    return {
        "ours, LichtFeld Studio: VGG, -1 to 1": lambda x, y: lpips(x.clamp(0, 1), y),
        "graphdeco, gsplat with lpips_net vgg: VGG, 0 to 1": unscaled,
    }


def main(options: Options) -> None:
    """Print a table for each score."""
    kinds = {"PSNR, dB": PSNRS, "SSIM": SSIMS}
    try:
        kinds["LPIPS"] = lpips_scores(load_lpips())
    except (MissingDependencyError, SceneNotFoundError) as error:
        print(f"LPIPS is left out: {error}\n")
    pairs: dict[str, list[tuple[Image, Image]]] = {}
    for run in options.runs:
        loaded = Evaluation.of(run).load()
        cpu = torch.device("cpu")
        pairs[run.name] = [
            (loaded.render(v).cpu(), photograph_tensor(v, cpu)) for v in loaded.views
        ]
    for kind, scores in kinds.items():
        digits, rows, ours = 3 if kind.startswith("PSNR") else 4, [], list[float]()
        for name, score in scores.items():
            values = [
                _pooled_psnr(views) if name.startswith("one mean")
                else float(np.mean([score(x, y) for x, y in views]))
                for views in pairs.values()
            ]  # fmt: skip
            ours = ours or values
            cells = [
                f"{value:.{digits}f} ({value - own:+.{digits}f})"
                for value, own in zip(values, ours, strict=True)
            ]
            rows.append((name, *cells))
        print(table((kind, *pairs), rows), end="\n\n")


def _pooled_psnr(views: list[tuple[Image, Image]]) -> float:
    """PSNR of the mean over all views of the squared error."""
    errors = [float((x.clamp(0, 1) - y).square().mean(dtype=torch.float64)) for x, y in views]
    return -10 * math.log10(float(np.mean(errors)))


if __name__ == "__main__":
    main(tyro.cli(Options))
