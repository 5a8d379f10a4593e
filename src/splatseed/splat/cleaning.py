"""Leaving out what no renderer can draw of a model that was read, so that every format gets it.

Kept are opacities of exactly 0 and 1, whose logits are infinite, sizes of 0 (a flat Gaussian), and
a rotation of length 0 where all three sizes are equal, as it turns nothing. Left out are Gaussians
with any other number that is not finite, with a size beyond e^20 or a position beyond 1e18 units,
whose squares overflow in a renderer, and with a rotation of length 0.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.errors import SceneFormatError
from splatseed.splat.gaussians import Gaussians
from splatseed.text import agreeing, counted

MAX_LOG_SCALE = 20.0
"""Larger sizes are left out; log-scales of compressed PLY end here, too."""
MAX_POSITION = 1e18
MIN_LOG_SCALE = float(np.log(np.finfo(np.float32).tiny))
"""The log-scale of a size of 0, which would be -infinity."""
_NORMS = (1e-6, 1e6)
"""Quaternions of other lengths are normalised: their squares may leave single precision."""
_ROUND = 1e-3  # largest difference of log-scales of a Gaussian that no rotation changes


def drop_unusable(path: Path, gaussians: Gaussians) -> tuple[Gaussians, str]:
    """The Gaussians that can be drawn, in order, and a note on those left out, empty if none are.

    Raises:
        SceneFormatError: None can be drawn.
    """
    norms = np.linalg.norm(gaussians.quats.astype(np.float64), axis=1)
    kinds = _unusable(gaussians, norms)
    bad = np.logical_or.reduce(list(kinds.values()))
    counts = {kind: int(np.count_nonzero(each)) for kind, each in kinds.items() if each.any()}
    if bad.all():
        raise SceneFormatError(
            f"{path} to hold Gaussians with finite numbers",
            found=f"{counted(len(bad), 'Gaussian')} without a usable {_listed(counts)}",
            fix="Train or export it again.",
        )
    note = ""
    if bad.any():
        number = int(np.count_nonzero(bad))
        note = (
            f"{counted(number, 'Gaussian')} of {len(bad):,} in {path} "
            f"{agreeing(number, 'has', 'have')} no usable {_listed(counts)} and "
            f"{agreeing(number, 'was', 'were')} left out (NaN, infinity or zero length)."
        )
        gaussians, norms = gaussians.select(~bad), norms[~bad]
    return _representable(gaussians, norms), note


def _unusable(
    gaussians: Gaussians, norms: Float64[np.ndarray, " N"]
) -> dict[str, Bool[np.ndarray, " N"]]:
    """Which Gaussians cannot be drawn, by the parameter at fault."""

    def infinite(*arrays: np.ndarray) -> Bool[np.ndarray, " N"]:
        flat = (each.reshape(len(each), -1) for each in arrays)
        return np.asarray(~np.stack([np.isfinite(each).all(axis=1) for each in flat]).all(axis=0))

    with np.errstate(invalid="ignore"):
        spread = gaussians.scales.max(axis=1) - gaussians.scales.min(axis=1)
        return {
            "position": ~(np.abs(gaussians.means) <= MAX_POSITION).all(axis=1),  # also NaN
            "size": ~(gaussians.scales <= MAX_LOG_SCALE).all(axis=1),  # also NaN
            "rotation": infinite(gaussians.quats) | ((norms == 0) & ~(spread < _ROUND)),
            "opacity": np.isnan(gaussians.opacities),
            "colour": infinite(gaussians.sh0, gaussians.shN),
        }


def _representable(gaussians: Gaussians, norms: Float64[np.ndarray, " N"]) -> Gaussians:
    """The same Gaussians, without sizes of 0 and quaternions of extreme length."""
    if (extreme := (norms < _NORMS[0]) | (norms > _NORMS[1])).any():
        quats = gaussians.quats.copy()
        lengths = np.where(norms > 0, norms, 1)[extreme, None]
        quats[extreme] = quats[extreme] / lengths
        quats[norms == 0] = (1, 0, 0, 0)
        gaussians = dataclasses.replace(gaussians, quats=quats)
    if (flat := gaussians.scales < MIN_LOG_SCALE).any():
        scales = np.where(flat, np.float32(MIN_LOG_SCALE), gaussians.scales)
        gaussians = dataclasses.replace(gaussians, scales=scales)
    return gaussians


def _listed(counts: dict[str, int]) -> str:
    """Such as "position (3), rotation (1)"; the count of a single kind goes without saying."""
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{kind} ({count:,})" for kind, count in counts.items())
