"""Drop Gaussians that no renderer can draw, for all formats alike.

Dropped are Gaussians with a NaN or infinite number, a size beyond e^20 or a position beyond 1e18
units (their squares overflow in a renderer), or a rotation of length 0. Kept are opacities of
exactly 0 and 1 (infinite logits), sizes of 0, and a rotation of length 0 of a sphere.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.progress import Note, silent_note
from splatseed.splat.gaussians import Gaussians
from splatseed.text import agreeing, counted

MAX_LOG_SCALE = 20.0
"""Log-scale of the largest size; also the limit of SOG."""
MAX_POSITION = 1e18
MIN_LOG_SCALE = float(np.log(np.finfo(np.float32).tiny))
"""Replaces the log-scale of a size of 0, -infinity."""
_NORMS = (1e-6, 1e6)
"""Quaternions of other lengths are normalised: their squares may overflow or underflow float32."""
_MAX_SPHERE_SPREAD = 1e-3  # largest difference of log-scales of a sphere


def drop_unusable(path: Path, gaussians: Gaussians, note: Note = silent_note) -> Gaussians:
    """Return the drawable Gaussians, in order; ``note`` is called if there are others."""
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
    if bad.any():
        number = int(np.count_nonzero(bad))
        text = (
            f"{counted(number, 'Gaussian')} of {len(bad):,} in {path} "
            f"{agreeing(number, 'has', 'have')} no usable {_listed(counts)} and "
            f"{agreeing(number, 'was', 'were')} left out (NaN, infinity or zero length)."
        )
        note(Finding("unusable-gaussians", text, subjects=(str(path),)))
        gaussians, norms = gaussians.select(~bad), norms[~bad]
    return _representable(gaussians, norms)


def _unusable(
    gaussians: Gaussians, norms: Float64[np.ndarray, " N"]
) -> dict[str, Bool[np.ndarray, " N"]]:
    """Return masks of the Gaussians that cannot be drawn, by the faulty parameter."""

    def not_finite(*arrays: np.ndarray) -> Bool[np.ndarray, " N"]:
        flat = (each.reshape(len(each), -1) for each in arrays)
        return np.asarray(~np.stack([np.isfinite(each).all(axis=1) for each in flat]).all(axis=0))

    with np.errstate(invalid="ignore"):
        spread = gaussians.scales.max(axis=1) - gaussians.scales.min(axis=1)
        return {
            "position": ~(np.abs(gaussians.means) <= MAX_POSITION).all(axis=1),  # also NaN
            "size": ~(gaussians.scales <= MAX_LOG_SCALE).all(axis=1),  # also NaN
            "rotation": not_finite(gaussians.quats)
            | ((norms == 0) & ~(spread < _MAX_SPHERE_SPREAD)),
            "opacity": np.isnan(gaussians.opacities),
            "colour": not_finite(gaussians.sh0, gaussians.shN),
        }


def _representable(gaussians: Gaussians, norms: Float64[np.ndarray, " N"]) -> Gaussians:
    """Replace sizes of 0 and quaternions of extreme length by equivalent ones."""
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
    """Format as "position (3), rotation (1)", or without a count if there is one kind."""
    if len(counts) == 1:
        return next(iter(counts))
    return ", ".join(f"{kind} ({count:,})" for kind, count in counts.items())
