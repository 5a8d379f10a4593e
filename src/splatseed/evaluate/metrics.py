"""The loop that scores renders of views: PSNR, SSIM, LPIPS.

Notation: a render and a photograph are [H, W, 3], sRGB values 0..1, not made linear. Promise:
renders are clamped to [0, 1] and not rounded to 8 bits; each view is scored at its own size; SSIM
has an 11 x 11 Gaussian window (sigma 1.5) and images mirrored at their edges, which is what
torchmetrics and so gsplat's trainer report.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from splatseed.errors import ParameterError
from splatseed.evaluate.images import psnr, ssim as ssim_inside
from splatseed.evaluate.lpips import Lpips
from splatseed.evaluate.result import NOT_ASKED, EvalResult, ViewScore
from splatseed.evaluate.ssim import WINDOW
from splatseed.progress import Progress, silent
from splatseed.splat.rendering import photograph_of
from splatseed.views.view import View

__all__ = ["Render", "evaluate_views"]

Render: TypeAlias = Callable[[View], Float[Tensor, "H W 3"]]
STAGE = "score"


@torch.no_grad()
def evaluate_views(
    render: Render,
    views: Sequence[View],
    *,
    lpips: Lpips | None = None,
    lpips_reason: str = NOT_ASKED,
    progress: Progress = silent,
) -> EvalResult:
    """Score renders of views against their photographs.

    The first view is rendered once more before, outside of the time, as a first call may compile.

    Args:
        render: Makes an image of a view, float [H, W, 3] of values about 0..1, on any device.
        views: Which; at least one.
        lpips: The network to measure LPIPS with; left out, LPIPS is not measured.
        lpips_reason: Why it is left out, for the reader of the result.
        progress: Told how far scoring is.

    Raises:
        ParameterError: There are no views, or a render has another size or is not finite.

    Example:
        >>> import numpy as np, torch
        >>> grey = np.full((16, 16, 3), 128, np.uint8)
        >>> view = View("grey.png", grey, np.eye(3), 16, 16, np.eye(4))
        >>> result = evaluate_views(lambda view: torch.zeros(16, 16, 3), [view])
        >>> round(result.psnr, 2)
        5.99
    """
    if not views:
        raise ParameterError(
            "views to score", found="none", fix="Keep some images for the test (test_every)."
        )
    render(views[0])
    scores = []
    for view in views:
        scores.append(_score(render, view, lpips))
        progress(STAGE, len(scores) / len(views))
    return EvalResult(
        tuple(scores),
        lpips_net=lpips.net if lpips else None,
        lpips_reason="" if lpips else lpips_reason,
    )


def _score(render: Render, view: View, lpips: Lpips | None) -> ViewScore:
    start = _now()
    image = render(view)
    seconds = _now() - start
    _check(image, view)
    clamped, truth = image.clamp(0.0, 1.0), photograph_of(view, image.device)
    return ViewScore(
        view.name,
        psnr=psnr(clamped, truth),
        ssim=_ssim(clamped, truth),
        lpips=None if lpips is None else lpips(clamped, truth),
        seconds=seconds,
    )


def _ssim(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> float:
    """SSIM averaged over all pixels; the mirrored margin lets the window fit at each of them."""
    margin = [WINDOW // 2] * 4
    mirrored = (
        pad(image.permute(2, 0, 1), margin, mode="reflect").permute(1, 2, 0) for image in (x, y)
    )
    return float(ssim_inside(*mirrored))


def _now() -> float:
    """The time once the GPU, if there is one in use, has done what it was asked for."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def _check(image: Tensor, view: View) -> None:
    expected = (view.height, view.width, 3)
    if tuple(image.shape) != expected:
        raise ParameterError(
            f"a render of {view.name} of shape {list(expected)}",
            found=f"{list(image.shape)}",
            fix="Render views at their own width and height.",
        )
    if not bool(torch.isfinite(image).all()):
        raise ParameterError(
            f"a render of {view.name} of finite values",
            found="NaN or infinity",
            fix="The model holds values that are not finite: train it again.",
        )
