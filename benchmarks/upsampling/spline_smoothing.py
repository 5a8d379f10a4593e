"""Why FITPACK's smoothing s does nothing at the paper's k = 25.

Notation: s bounds a fit's squared residual; inner knots are those beyond the corners of a single
bicubic polynomial. Promise: SciPy's own ``SmoothBivariateSpline`` on neighbourhoods of the made
room in their principal axes, scaled to unit reach, where a height field fits them best.
"""

from __future__ import annotations

import warnings

import numpy as np
from benchmarks.common.clouds import room
from benchmarks.common.markdown import table
from scipy.interpolate import SmoothBivariateSpline

from splatseed.methods.neighbors import prepare
from splatseed.methods.patches import local_frames

__all__ = ["smoothing_table"]

NEIGHBORS = 25
CORNER_KNOTS = 8
"""Knots along an axis of a cubic without inner knots."""
PATCHES = 300
SMOOTHING = (0.0, 0.001, 0.1, 0.1 * NEIGHBORS, 1000.0)
PROBES = 20


def smoothing_table() -> str:
    """Inner knots, and how far the surface moves from that of s = 0, for several s."""
    patches, rng = _patches(), np.random.default_rng(1)
    probes = rng.uniform(-0.5, 0.5, (2, PROBES))
    reference = [_heights(patch, 0.0, probes)[0] for patch in patches]
    header = ["s", "patches with an inner knot", "largest change of a height, units of the reach"]
    rows = []
    for s in SMOOTHING:
        fits = [_heights(patch, s, probes) for patch in patches]
        knots = np.mean([has_knot for _, has_knot in fits])
        change = max(np.abs(h - r).max() for (h, _), r in zip(fits, reference, strict=True))
        rows.append([f"{s:g}", f"{100 * knots:.1f}%", f"{change:.2g}"])
    return table(header, rows)


def _patches() -> list[np.ndarray]:
    """u, v, z of k neighbours and the base, [3, k + 1], for some bases."""
    cloud = prepare(room(20_000))
    neighbors = cloud.neighbors(NEIGHBORS)
    frames, _ = local_frames(cloud.xyz, neighbors.idx)
    chosen = np.random.default_rng(0).choice(len(cloud), PATCHES, replace=False)
    patches = []
    for i in chosen:
        around = np.concatenate([cloud.xyz[neighbors.idx[i]], cloud.xyz[i : i + 1]])
        patches.append(frames[i] @ (around - cloud.xyz[i]).T / neighbors.distance[i, -1])
    return patches


def _heights(patch: np.ndarray, s: float, probes: np.ndarray) -> tuple[np.ndarray, bool]:
    """Heights at the probes, and whether the fit has an inner knot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # FITPACK warns of nearly every patch
        surface = SmoothBivariateSpline(*patch, s=s)
    has_knot = any(len(knots) > CORNER_KNOTS for knots in surface.get_knots())
    return surface.ev(*probes), has_knot
