"""Compare larger photographs, starting from the planes that smaller ones gave.

The planes are nearly right already: one sweep refines them. Promise: as in ``matching``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from splatseed.depth.stereo.maps import StereoResult
from splatseed.depth.stereo.matching import DepthPrior, match_views
from splatseed.photos.view import View
from splatseed.progress import Progress

SWEEPS = 1
"""PatchMatch iterations: with a second one the same pixels are confirmed, no more accurately."""


def compare_closer(
    coarse: StereoResult, views: Sequence[View], grid: int, seed: int, progress: Progress
) -> StereoResult:
    """Match photographs that were matched at a smaller size before.

    Args:
        coarse: The result at the smaller size.
        views: The same photographs in the same order, as large or larger.
        grid: Pixels of these between depths.
        seed: The same seed gives the same bytes.
        progress: Called with the stage, as in ``match_views`` with "again", and the fraction done.
    """
    priors = [_prior(coarse, i, view) for i, view in enumerate(views)]
    settings = dataclasses.replace(coarse.settings, grid=grid, sweeps=SWEEPS)

    def again(stage: str, fraction: float) -> None:
        progress(f"{stage} again", fraction)

    return match_views(views, priors, coarse.sources, settings, seed, again)


def _prior(coarse: StereoResult, i: int, view: View) -> DepthPrior | None:
    """The planes of view i in pixels of the larger photograph; None without any."""
    if not np.isfinite(coarse.costs[i]).any():
        return None
    # Both are whole divisions of the same photograph, so focal lengths have the ratio of sizes.
    ratio = view.K[0, 0] / coarse.views[i].K[0, 0]
    planes = coarse.planes[i].copy()
    planes[1:] /= np.float32(ratio)  # slopes are per pixel
    step = coarse.settings.grid * ratio
    return DepthPrior(np.empty((0, 2)), np.empty(0), coarse.bounds[i], planes, step)
