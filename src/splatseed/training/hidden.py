"""Colours of the Gaussians that no photograph shows, because others are in front of them.

Where dropout leaves out the Gaussians in front, a pixel trains those behind, until they have the
colours of what hides them. A camera that looks past it sees these colours around it. So after the
last step hidden Gaussians take the colours of the visible ones beside them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32
from scipy.spatial import KDTree

from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import opacity_from_logits, render_view
from splatseed.training.parameters import Parameters, gaussians_of
from splatseed.training.strategies.grow import contributions

HIDDEN = 0.1
"""A Gaussian is hidden if every view shows less of it than this fraction of the dropout. With a
higher one training photographs lose what many such Gaussians add to them."""
VISIBLE = 0.3
"""It is visible if a view shows this fraction of it."""
NEIGHBORS = 16


def recolored(
    params: Parameters, views: Sequence[View], dropout: float, progress: Progress = silent
) -> Gaussians:
    """Return the Gaussians, of which hidden ones have the mean colour of the nearest visible ones.

    The more is visible of one, the more is left of its own colour and harmonics.

    Args:
        params: The parameter dict.
        views: The training views, in the frame of the Gaussians.
        dropout: The fraction of Gaussians that the last step dropped; 0 changes none.
        progress: Called with the stage and the fraction done.
    """
    gaussians = gaussians_of(params)
    if not dropout:
        return gaussians
    shown, limit = visible_fractions(params, views, progress), HIDDEN * dropout
    hidden, visible = np.flatnonzero(shown < limit), np.flatnonzero(shown >= VISIBLE)
    if not len(hidden) or len(visible) < NEIGHBORS:
        return gaussians
    means, sh0, shN = gaussians.means, gaussians.sh0.copy(), gaussians.shN.copy()
    _, nearest = KDTree(means[visible]).query(means[hidden], NEIGHBORS)
    own = (shown[hidden] / limit)[:, None, None]
    sh0[hidden] = own * sh0[hidden] + (1 - own) * sh0[visible[nearest]].mean(axis=1)
    shN[hidden] *= own
    return dataclasses.replace(gaussians, sh0=sh0, shN=shN)


@torch.no_grad()
def visible_fractions(
    params: Parameters, views: Sequence[View], progress: Progress = silent
) -> Float32[np.ndarray, " N"]:
    """Return the largest fraction of each Gaussian that a view shows, NaN if it is in no frame.

    The fraction is the mean transmittance in front of it, sum_p w_p / sum_p alpha_p over the pixels
    p, where w is its weight and the sum of its alpha is opacity 2 pi sqrt(det covariance). It is 1
    if the Gaussian reaches across the edge of a frame, where the sums do not compare.
    """
    opacities = opacity_from_logits(params["opacities"].detach())
    largest = torch.full_like(opacities, math.nan)
    for i, view in enumerate(views):
        pixels, _ = contributions(params, view, opacities.new_zeros((view.height, view.width)))
        _, info = render_view(params, view, 0)
        xx, xy, yy = info["conics"][0].unbind(-1)
        unhidden = opacities * 2 * math.pi / torch.sqrt(xx * yy - xy**2)
        u, v = info["means2d"][0].unbind(-1)
        reach = info["radii"][0].amax(dim=-1)
        # The distance of the centre from the edges, positive within.
        inside = torch.stack([u, view.width - u, v, view.height - v]).amin(dim=0)
        fraction = torch.where(inside > reach, pixels / unhidden, 1.0)
        in_frame = (reach > 0) & (inside > 0)
        largest = torch.where(in_frame, torch.fmax(largest, fraction), largest)
        progress("hidden Gaussians", (i + 1) / len(views))
    return np.asarray(largest.cpu().numpy())
