"""Keep the Gaussians of a model that its renders need most, within a budget.

Notation: the colour C_pc of pixel p and channel c is linear in the opacity o_i of each Gaussian, so
that without Gaussian i it changes by D_ipc = -o_i dC_pc / do_i. Its *need* is the sum of D_ipc^2
over the pixels of the training views: the squared error that leaving it out makes. Unlike a sum of
blending weights, it is small where what lies behind has the same colour.

Two Gaussians that cover each other have little need, but not both: they are left out in rounds, and
the need is measured again for each.

One gradient gives all needs of a view: with random signs z_pc, the expectation of
(sum_pc z_pc D_ipc)^2 is the sum of D_ipc^2 (Hutchinson 1990). Photographs have no part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32

from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.sampling import evenly_spaced
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.photographs import mask_tensor
from splatseed.splat.rendering import ModelRenderer, opacity_from_logits, render_view
from splatseed.splat.selection import largest
from splatseed.training.model_views import ModelViews
from splatseed.training.parameters import make_parameters

MAX_MEASURED_LOGIT = 6.0
"""Opacities above 0.9975 are measured as 0.9975: an alpha that is clamped to 0.999 has no
gradient."""
MIN_SHARE = 0.7
"""Of the Gaussians, the smallest share that a round keeps."""
SHARES = (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.4, 0.5)
"""By which Gaussians are widened, at most."""
MAX_FITTED = 8
"""Training views in which sizes are fitted."""


def most_needed(
    gaussians: Gaussians,
    views: ModelViews,
    count: int,
    device: torch.device,
    progress: Progress = silent,
) -> Bool[np.ndarray, " N"]:
    """Return the mask of the ``count`` Gaussians with the greatest need.

    Args:
        gaussians: In the frame of the views.
        views: Of the model's scene; the training views have a part.
        count: Number of Gaussians to keep.
        device: Where to render.
        progress: Called with the name of a stage and its fraction done.
    """
    framed = views.frame.gaussians_from_world(gaussians)
    seen = [views.frame.view(view) for view in views.train if view.name not in views.frame.strays]
    kept, rounds = np.arange(len(framed)), num_rounds(len(framed), count)
    for i in range(rounds):
        share = (count / len(framed)) ** ((i + 1) / rounds)
        number = count if i == rounds - 1 else round(len(framed) * share)

        def whole(stage: str, fraction: float, done: int = i) -> None:
            progress(stage, (done + fraction) / rounds)

        kept = kept[largest(needs(framed.select(kept), seen, device, whole), number)]
    keep = np.zeros(len(framed), bool)
    keep[kept] = True
    return keep


@torch.no_grad()
def fit_sizes(
    kept: Gaussians,
    whole: Gaussians,
    views: ModelViews,
    device: torch.device,
    progress: Progress = silent,
) -> tuple[Gaussians, float]:
    """Widen the Gaussians that are kept to close the gaps between them; return by what share, too.

    The share is that of ``SHARES`` whose renders come closest to those of the whole model, in some
    of the training views.
    """
    seen = [views.train[i] for i in evenly_spaced(len(views.train), MAX_FITTED)]
    renderer = ModelRenderer(whole, views.frame, device, views.scene.background)
    targets = [renderer.image(view) for view in seen]
    best, share, least = kept, 0.0, math.inf
    for i, wider in enumerate(SHARES):
        model = dataclasses.replace(kept, scales=kept.scales + np.float32(math.log1p(wider)))
        renderer = ModelRenderer(model, views.frame, device, views.scene.background)
        pairs = zip(seen, targets, strict=True)
        error = sum(float((renderer.image(view) - each).square().sum()) for view, each in pairs)
        progress("fit sizes", (i + 1) / len(SHARES))
        if error >= least:
            break
        best, share, least = model, wider, error
    progress("fit sizes", 1.0)
    return best, share


def num_rounds(count: int, budget: int) -> int:
    """Return how many rounds lead from a number of Gaussians to a smaller one.

    Example:
        >>> num_rounds(1000, 750), num_rounds(1000, 250)
        (1, 4)
    """
    return max(1, math.ceil(math.log(count / budget) / -math.log(MIN_SHARE)))


def needs(
    gaussians: Gaussians, views: Sequence[View], device: torch.device, progress: Progress = silent
) -> Float32[np.ndarray, " N"]:
    """Estimate the need of each Gaussian; masked pixels do not count.

    Args:
        gaussians: In the frame of the views.
        views: One or more.
        device: Where to render.
        progress: Called with the name of a stage and its fraction done.
    """
    params = {name: each.detach() for name, each in make_parameters(gaussians, device).items()}
    logits = params["opacities"].clamp(max=MAX_MEASURED_LOGIT).requires_grad_()
    params["opacities"] = logits
    transparency = 1 - opacity_from_logits(logits.detach())
    total = torch.zeros_like(transparency)
    generator = torch.Generator().manual_seed(0)
    for i, view in enumerate(views):
        image = render_view(params, view, gaussians.sh_degree)[0]
        signs = 2.0 * torch.randint(0, 2, image.shape, generator=generator) - 1
        if (mask := mask_tensor(view, torch.device("cpu"))) is not None:
            signs = signs * mask[..., None]
        (slope,) = torch.autograd.grad((image * signs.to(device)).sum(), logits)
        # do = o (1 - o) d(logit), so o dC/do = dC/d(logit) / (1 - o)
        total += (slope / transparency).square()
        progress("weigh Gaussians", (i + 1) / len(views))
    return np.asarray(total.cpu().numpy())
