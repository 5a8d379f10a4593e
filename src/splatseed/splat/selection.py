"""Choose the Gaussians of a model to keep: by region, opacity, number, or their neighbours.

Photographs have no part here; ``training.decimation`` and ``training.floaters`` use them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree

from splatseed.errors import ParameterError
from splatseed.io.regions import Region
from splatseed.splat.gaussians import VISIBLE_LOGIT, Gaussians


@dataclass(frozen=True)
class IsolationSettings:
    """Constants of ``isolated``: measured in ``benchmarks.export_choices``."""

    neighbors: int = 16  # nearest ones, whose gaps are compared
    gaps: int = 8  # the smallest, whose mean counts
    max_gap: float = 4.0  # that mean beyond which a Gaussian is isolated
    block: int = 1 << 18  # Gaussians at a time


ISOLATION = IsolationSettings()


def filter_gaussians(
    gaussians: Gaussians, crop: Region | None = None, min_opacity: float = 0.0
) -> Gaussians:
    """Keep Gaussians with centres in the region ``crop`` and at least ``min_opacity``, in order."""
    keep = kept_by_filter(gaussians, crop, min_opacity)
    return gaussians if keep.all() else gaussians.select(keep)


def kept_by_filter(
    gaussians: Gaussians, crop: Region | None = None, min_opacity: float = 0.0
) -> Bool[np.ndarray, " N"]:
    """Return the mask of ``filter_gaussians``, which keeps some.

    Raises:
        ParameterError: ``min_opacity`` is out of range, or nothing is left.
    """
    if not 0 <= min_opacity < 1:
        raise ParameterError(
            "`min_opacity` of 0 or more, less than 1", found=f"{min_opacity}", fix="Try 0.05."
        )
    keep = np.ones(len(gaussians), bool)
    if min_opacity:
        keep &= gaussians.opacities >= np.log(min_opacity / (1 - min_opacity))
    if crop is not None:
        keep &= crop(gaussians.means)
    if not keep.any():
        ends = (end(gaussians.means, axis=0) for end in (np.min, np.max))
        low, high = (" ".join(f"{value:.4g}" for value in end) for end in ends)
        raise ParameterError(
            "`crop` and `min_opacity` to leave some Gaussians",
            found=f"none of {len(gaussians):,}, whose centres lie from {low} to {high}",
            fix="Choose a larger region or a smaller opacity.",
        )
    return keep


def visible_area(gaussians: Gaussians) -> Float64[np.ndarray, " N"]:
    """Return each Gaussian's opacity times the area of its two larger sizes.

    This ranks Gaussians where no photographs are there.
    """
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-gaussians.opacities.astype(np.float64)))
    larger = np.sort(gaussians.scales.astype(np.float64), axis=1)[:, 1:]
    return np.asarray(opacity * np.exp(larger.sum(axis=1)))


def largest(importance: Float[np.ndarray, " N"], count: int) -> Bool[np.ndarray, " N"]:
    """Return the mask of the ``count`` largest values, of equal ones the first."""
    keep = np.zeros(len(importance), bool)
    keep[np.argsort(-importance, kind="stable")[:count]] = True
    return keep


def isolated(gaussians: Gaussians) -> Bool[np.ndarray, " N"]:
    """Find visible Gaussians that are far from all others for their size: floaters, mostly.

    Surfaces are covered: neighbouring Gaussians overlap, large ones of a distant background as
    much as small ones of a detail. The *gap* between two Gaussians is their distance over the sum
    of their largest standard deviations. A Gaussian is isolated if the mean of its 8 smallest gaps,
    of those to its 16 nearest visible neighbours, is over 4. Absolute distances, as in statistical
    outlier removal, would take a sparse background for noise.
    """
    visible = np.flatnonzero(gaussians.opacities > VISIBLE_LOGIT)
    found = np.zeros(len(gaussians), bool)
    if len(visible) <= ISOLATION.gaps:
        return found
    means = gaussians.means[visible].astype(np.float64)
    sizes = np.exp(gaussians.scales[visible].max(axis=1).astype(np.float64))
    tree, k = cKDTree(means), min(ISOLATION.neighbors + 1, len(visible))
    for start in range(0, len(visible), ISOLATION.block):
        block = slice(start, start + ISOLATION.block)
        distances, idx = tree.query(means[block], k, workers=-1)
        reach = np.maximum(sizes[block, None] + sizes[idx], np.finfo(np.float64).tiny)
        gaps = distances / reach
        gaps[idx == np.arange(len(visible))[block, None]] = np.inf  # itself
        smallest = np.partition(gaps, ISOLATION.gaps - 1, axis=1)[:, : ISOLATION.gaps]
        found[visible[block]] = smallest.mean(axis=1) > ISOLATION.max_gap
    return found
