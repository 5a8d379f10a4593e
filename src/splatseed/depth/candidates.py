"""The candidates of all images, how far each can be trusted, and the choice among them.

Notation: C candidates; ``tier`` 0 is sound, then come ``UNCONFIRMED``, ``NEAR_EDGE`` and
``DISTRUSTED``.
Promise: a candidate of a higher tier is taken only after all of the lower tiers; within one tier,
points are spread evenly in space, or every image gives the same number as far as it can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.depth.consistency import Support, find_support
from splatseed.depth.neighbors import choose_neighbors
from splatseed.depth.planar import lift_pixels
from splatseed.depth.scale_synchronisation import synchronize_scales
from splatseed.depth.settings import Settings
from splatseed.depth.views import Reduced, View
from splatseed.depth.voxel_thinning import thin_by_voxels
from splatseed.errors import PointCloudError
from splatseed.progress import Progress, in_threads

SOUND, UNCONFIRMED, NEAR_EDGE, DISTRUSTED = range(4)
"""Tiers, in the order in which they are used up; the last is never used."""
PIECE = 4
"""Views per task of a thread."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points that could be added, view after view.

    Args:
        xyz: World positions, float32 [C, 3].
        rgb: Colours, uint8 [C, 3].
        footprint: Size of a pixel at their depth, scene units, float32 [C].
        tier: How far each can be trusted, uint8 [C].
        counts: Number of candidates of each view, int64 [V].
    """

    xyz: Float32[np.ndarray, "C 3"]
    rgb: UInt8[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]
    tier: UInt8[np.ndarray, " C"]
    counts: Int64[np.ndarray, " V"]

    @cached_property
    def num_sound(self) -> int:
        """Number of candidates of the lowest tier."""
        return int(np.count_nonzero(self.tier == SOUND))


def gather(views: Sequence[View], settings: Settings, progress: Progress) -> Candidates:
    """Lift the views' candidates, and compare them with other views if the settings say so."""
    counts = np.array([len(view) for view in views])
    neighbors = choose_neighbors(views, settings.num_neighbors, progress)
    factors = np.ones(len(views))
    if settings.synchronizes:
        factors = synchronize_scales(views, neighbors, progress)
    copies = _rescaled(views, factors)
    total, start_of = int(counts.sum()), np.cumsum(counts) - counts
    candidates = Candidates(
        np.empty((total, 3), np.float32),
        np.concatenate([view.rgb for view in views]),
        np.empty(total, np.float32),
        np.zeros(total, np.uint8),
        counts,
    )

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            mine = slice(start_of[i], start_of[i] + counts[i])
            _fill(candidates, mine, views[i], float(factors[i]))
            asked = [copy for j in neighbors[i] if j >= 0 and (copy := copies[j]) is not None]
            own = copies[i]
            if settings.compares_views and own is not None:
                support = find_support(candidates.xyz[mine], own, asked, settings)
                candidates.tier[mine] = _tier(views[i], support, settings)

    in_threads(work, len(views), PIECE, "compare views", progress)
    return candidates


def _fill(candidates: Candidates, mine: slice, view: View, factor: float) -> None:
    """Write a view's candidates into their slice."""
    lift_pixels(view.pixel, view.z, view.camera, candidates.xyz[mine], factor)
    # A pixel at depth z is z / focal wide.
    np.multiply(view.z, factor / view.camera.K[0, 0], out=candidates.footprint[mine])
    candidates.tier[mine][view.edge] = NEAR_EDGE


def _rescaled(views: Sequence[View], factors: Float64[np.ndarray, " V"]) -> list[Reduced | None]:
    """The reduced copies, with depth multiplied."""
    return [
        view.reduced and replace(view.reduced, factor=view.reduced.factor * factor)
        for view, factor in zip(views, factors.tolist(), strict=True)
    ]


def _tier(view: View, support: Support, settings: Settings) -> UInt8[np.ndarray, " C"]:
    tier = np.where(support.agreeing >= settings.min_agreeing, SOUND, UNCONFIRMED).astype(np.uint8)
    # Later assignments override earlier ones: the worst tier counts.
    tier[view.edge] = NEAR_EDGE
    if not settings.see_through:
        tier[support.seen_through] = DISTRUSTED
    return tier


def choose(
    candidates: Candidates,
    originals: Float32[np.ndarray, "N 3"],
    num: int,
    settings: Settings,
    rng: np.random.Generator,
    progress: Progress,
) -> Int64[np.ndarray, " num"]:
    """Choose exactly ``num`` candidates, ascending indices.

    Args:
        candidates: The candidates to choose from.
        originals: Points that exist already.
        num: How many.
        settings: Whether they are spread in space, or each image gives the same number.
        rng: Draws where nothing else distinguishes candidates.
        progress: Called with the stage and the fraction done.

    Raises:
        PointCloudError: There are too few that may be used.
    """
    progress("choose points", 0.0)
    usable = int(np.count_nonzero(candidates.tier < DISTRUSTED))
    if usable < num:
        larger = " or a larger --depth.region" if settings.region < 1 else ""
        raise PointCloudError(
            f"depth maps that can give {num:,} points",
            found=f"{usable:,} that no other view looks through" if usable else "none",
            fix=f"Ask for fewer, or allow more with --depth.see-through{larger}.",
        )
    taken = np.zeros(len(candidates.tier), bool)
    missing = num
    for tier in range(DISTRUSTED):
        members = candidates.tier == tier
        if missing < np.count_nonzero(members):
            there = np.concatenate([originals, candidates.xyz[taken]])
            members = _pick(candidates, members, there, missing, settings, rng)
        taken |= members
        missing -= int(np.count_nonzero(members))
        if missing == 0:
            break
    progress("choose points", 1.0)
    return np.flatnonzero(taken)


def _pick(
    candidates: Candidates,
    members: Bool[np.ndarray, " C"],
    there: Float32[np.ndarray, "N 3"],
    num: int,
    settings: Settings,
    rng: np.random.Generator,
) -> Bool[np.ndarray, " C"]:
    """Which ``num`` of the members of a tier to take, given the points chosen before."""
    if settings.spread:
        xyz, footprint = candidates.xyz, candidates.footprint
        return thin_by_voxels(xyz, footprint, members, there, num, rng)
    which = np.flatnonzero(members)
    view_idx = np.repeat(np.arange(len(candidates.counts)), candidates.counts)
    picked = np.zeros(len(members), bool)
    picked[which[_even_shares(view_idx[which], num, rng)]] = True
    return picked


def _even_shares(
    view_idx: Int64[np.ndarray, " C"], num: int, rng: np.random.Generator
) -> Int64[np.ndarray, " num"]:
    """``num`` of C indices, as many from every view as it and the others have."""
    order = rng.permutation(len(view_idx))
    order = order[np.argsort(view_idx[order], kind="stable")]
    counts = np.bincount(view_idx)
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    # The first of every view, then the second of every view, and so on.
    return np.asarray(order[np.argsort(place, kind="stable")[:num]])
