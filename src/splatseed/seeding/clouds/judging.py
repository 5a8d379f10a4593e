"""Which voxels of a cloud stay: those that a photograph sees and nothing contradicts.

Notation: four things contradict a voxel. Views *see past* it (``evidence``); the photographs that
see it do not *agree* on its colour, although no ray ends there; they show *another colour* than the
cloud; or it lies *alone*: its support (``support``) is below ``ALONE`` of the median. Ghosts also
hide what is behind them, so where many voxels go, the others are judged once more without them.
Promise: depends neither on the order of the points nor on the threads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from splatseed.errors import PointCloudError
from splatseed.progress import Progress
from splatseed.seeding.clouds.evidence import (
    Evidence,
    FreeRays,
    find_evidence,
    find_surfaces,
    surface_agreement,
)
from splatseed.seeding.clouds.support import find_support
from splatseed.seeding.clouds.voxels import Voxels
from splatseed.views.view import View

AGREES = 0.5
"""Least agreement of the photographs on a voxel's colour, where at least ``ASKED`` see it."""
ASKED = 4
THROUGH = 2
"""Views that see past a voxel from which on it is not there, if fewer confirm it."""
CONFIRMED = 2
"""Views that confirm a voxel from which on the photographs need not agree on its colour."""
OTHER = 64
"""Grey levels by which colours differ clearly, beside ``LIKELY`` times what they differ by
anyway."""
LIKELY = 4.0
ALONE = 0.05
AGAIN = 0.002
"""Share of voxels that go from which on the others are judged once more."""


@dataclass(frozen=True, eq=False)
class Judged:
    """The verdict on a cloud's voxels.

    Args:
        kept: Those that stay, rising, int64 [K].
        evidence: On these.
        fit: Of the scene's own points seen where the cloud has a surface, the share at its depth.
        asked: The number of these points.
        hidden: Voxels that no photograph sees.
        reasons: How many others went, by reason.
    """

    kept: Int64[np.ndarray, " K"]
    evidence: Evidence
    fit: float
    asked: int
    hidden: int
    reasons: dict[str, int]


def judge(
    views: Sequence[View],
    seen: Sequence[Float64[np.ndarray, "M 3"]],
    voxels: Voxels,
    colors: UInt8[np.ndarray, "N 3"] | None,
    progress: Progress,
    *,
    clean: bool = True,
    rays: FreeRays | None = None,
) -> Judged:
    """Judge the voxels of a cloud.

    Args:
        views: The photographs; without pixels only their frames count.
        seen: The scene's own points that each view sees, world.
        voxels: The cloud.
        colors: Its own colours, where it has some.
        progress: Told how far it is.
        clean: Whether contradicted voxels go, or only hidden ones.
        rays: Where rays are known to be free.

    Raises:
        PointCloudError: No photograph sees any voxel.
    """
    reasons: Counter[str] = Counter()
    active = np.arange(len(voxels))
    if clean:
        lone = _alone(voxels)
        reasons["lie alone"] = int(np.count_nonzero(lone))
        active = active[~lone]
    for last in (False, True):
        xyz = voxels.xyz[active]
        surfaces, cell = find_surfaces(views, xyz, progress)
        evidence = find_evidence(views, xyz, surfaces, cell, rays, progress)
        against = np.zeros(len(active), bool)
        if clean:
            against, counts = _against(evidence, None if colors is None else colors[active])
            reasons.update(counts)
        if last or np.count_nonzero(against) <= AGAIN * len(active):
            break
        active = active[~against]
    visible = evidence.seen > 0
    if not visible.any():
        raise PointCloudError(
            "points of the cloud that a photograph sees", found="none", fix="Check its frame."
        )
    fit, asked = surface_agreement(views, surfaces, seen)
    stay = visible & ~against
    hidden = int(np.count_nonzero(~visible & ~against))
    return Judged(active[stay], evidence.select(stay), fit, asked, hidden, reasons)


def _alone(voxels: Voxels) -> Bool[np.ndarray, " N"]:
    """Which voxels have next to no points around them."""
    support = find_support(voxels.xyz, voxels.side, voxels.count)
    return np.asarray(support < ALONE * np.median(support))


def _against(
    evidence: Evidence, colors: UInt8[np.ndarray, "N 3"] | None
) -> tuple[Bool[np.ndarray, " N"], dict[str, int]]:
    """Which voxels are contradicted, and how many by reason; the first counts."""
    past = (evidence.through >= THROUGH) & (evidence.through > evidence.confirmed)
    torn = (evidence.seen >= ASKED) & (evidence.agreement < AGREES)  # NaN compares false
    torn &= evidence.confirmed < CONFIRMED  # what shines looks different from all sides
    other = np.zeros_like(past)
    known = ~np.isnan(evidence.agreement)
    if colors is not None and known.any():
        apart = np.abs(colors.astype(np.int16) - evidence.rgb).max(axis=1)
        other = known & (apart > OTHER + LIKELY * np.median(apart[known]))
    against = np.zeros_like(past)
    counts = {}
    named = {
        "are seen past": past,
        "have another colour than the photographs": other,
        "look different in every photograph": torn,
    }
    for reason, which in named.items():
        counts[reason] = int(np.count_nonzero(which & ~against))
        against |= which
    return against, counts
