"""The loop that scores renders of views: PSNR, SSIM, LPIPS.

Notation: a render and a photograph are [H, W, 3], sRGB values 0..1, not linearised. Promise:
renders are clamped to [0, 1] and not rounded to 8 bits; each view is scored at its own size; SSIM
has an 11 x 11 Gaussian window (sigma 1.5) and images mirrored at their edges, which is what
torchmetrics and so gsplat's trainer report.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseed.errors import ParameterError
from splatseed.evaluate.images import psnr, psnr_within, ssim_of_all
from splatseed.evaluate.lpips import Lpips
from splatseed.progress import Progress, silent
from splatseed.scores import NOT_ASKED, EvalResult, ViewScore
from splatseed.splat.photographs import photograph_of
from splatseed.views.view import View

Covisible: TypeAlias = Mapping[str, Bool[np.ndarray, "H W"]]
"""Which pixels of each test view at least two training views see, by the view's name."""
Render: TypeAlias = Callable[[View], Float[Tensor, "H W 3"]]
STAGE = "score"


@torch.no_grad()
def evaluate_views(
    render: Render,
    views: Sequence[View],
    *,
    lpips: Lpips | None = None,
    lpips_reason: str = NOT_ASKED,
    covisible: Covisible | None = None,
    progress: Progress = silent,
) -> EvalResult:
    """Score renders of views against their photographs.

    The first view is rendered once more beforehand, untimed, because a first call may compile.

    Args:
        render: Renders a view as float [H, W, 3], values about 0..1, on any device.
        views: The views; at least one.
        lpips: The LPIPS metric; LPIPS is not measured when left out.
        lpips_reason: Why it is left out, for the reader of the result.
        covisible: The pixels over which PSNR is also computed, for the views it contains; see
            ``evaluate.covisible``.
        progress: Called with the stage and the fraction done.

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
            "views to score", found="none", fix="Hold out some images for testing (test_every)."
        )
    render(views[0])
    scores = []
    for view in views:
        scores.append(_score(render, view, lpips, (covisible or {}).get(view.name)))
        progress(STAGE, len(scores) / len(views))
    return EvalResult(
        tuple(scores),
        lpips_net=lpips.net if lpips else None,
        lpips_reason="" if lpips else lpips_reason,
    )


def _score(
    render: Render, view: View, lpips: Lpips | None, seen: Bool[np.ndarray, "H W"] | None
) -> ViewScore:
    start = _now()
    image = render(view)
    seconds = _now() - start
    _check(image, view)
    clamped, photograph = image.clamp(0.0, 1.0), photograph_of(view, image.device)
    return ViewScore(
        view.name,
        psnr=psnr(clamped, photograph),
        ssim=ssim_of_all(clamped, photograph),
        lpips=None if lpips is None else lpips(clamped, photograph),
        seconds=seconds,
        covisible_psnr=None
        if seen is None
        else psnr_within(clamped, photograph, _mask(seen, photograph)),
        covisible_share=None if seen is None else float(seen.mean()),
    )


def _mask(seen: Bool[np.ndarray, "H W"], photograph: Tensor) -> Bool[Tensor, "H W"]:
    """A mask on the photograph's device."""
    return torch.from_numpy(seen).to(photograph.device)


def _now() -> float:
    """The time, once the GPU, if one is in use, has finished its work."""
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
            fix="The model has values that are not finite: train it again.",
        )
