"""The candidates of all images in one list, how far each can be trusted, and the choice among them.

Notation: C candidates; ``tier`` 0 is sound, then come ``UNCONFIRMED``, ``NEAR_EDGE`` and ``DISTRUSTED``.
Promise: a candidate of a higher tier is taken only if all of the lower tiers are; among those of one
tier, points are spread evenly in space, or every image gives the same number as far as it can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8

from splatseed.depth.consistency import Support, find_support
from splatseed.depth.neighbors import choose_neighbors
from splatseed.depth.settings import Settings
from splatseed.depth.spreading import spread_points
from splatseed.depth.views import View
from splatseed.errors import PointCloudError
from splatseed.progress import Progress, in_threads

__all__ = ["DISTRUSTED", "NEAR_EDGE", "UNCONFIRMED", "Candidates", "choose", "gather"]

SOUND, UNCONFIRMED, NEAR_EDGE, DISTRUSTED = range(4)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points that could be added, image after image.

    Args:
        xyz: World positions, float32 [C, 3].
        rgb: Colours, uint8 [C, 3].
        footprint: Size of a pixel at their depth, scene units, float32 [C].
        image_idx: Which view each comes from, int32 [C].
        tier: How far each can be trusted, uint8 [C].
    """

    xyz: Float32[np.ndarray, "C 3"]
    rgb: UInt8[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]
    image_idx: Int32[np.ndarray, " C"]
    tier: UInt8[np.ndarray, " C"]

    @cached_property
    def num_sound(self) -> int:
        """How many are of the lowest tier."""
        return int(np.count_nonzero(self.tier == SOUND))


def gather(views: Sequence[View], settings: Settings, progress: Progress) -> Candidates:
    """Put the views' candidates together, held against other views if the settings say so."""
    tiers = _tiers(views, settings, progress)
    counts = [len(view.xyz) for view in views]
    return Candidates(
        np.concatenate([view.xyz for view in views]),
        np.concatenate([view.rgb for view in views]),
        np.concatenate([view.footprint for view in views]),
        np.repeat(np.arange(len(views), dtype=np.int32), counts),
        np.concatenate(tiers),
    )


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
        candidates: Of which to choose.
        originals: Points that are there already.
        num: How many.
        settings: Whether they are spread in space, or each image gives as many.
        rng: Draws where there is nothing to tell candidates apart.
        progress: Told when it is done.

    Raises:
        PointCloudError: There are too few that may be used.
    """
    progress("choose points", 0.0)
    usable = int(np.count_nonzero(candidates.tier < DISTRUSTED))
    if usable < num:
        raise PointCloudError(
            f"depth maps that can give {num:,} points",
            found=f"{usable:,} that no other view looks through" if usable else "none",
            fix="Ask for fewer, or allow more with --depth.see-through or a larger --depth.region.",
        )
    chosen = np.empty(0, np.int64)
    for tier in range(DISTRUSTED):
        members = np.flatnonzero(candidates.tier == tier)
        missing = num - len(chosen)
        if missing < len(members):
            taken = np.concatenate([originals, candidates.xyz[chosen]])
            members = members[_pick(candidates, members, taken, missing, settings, rng)]
        chosen = np.concatenate([chosen, members])
        if len(chosen) == num:
            break
    progress("choose points", 1.0)
    return np.sort(chosen)


def _pick(
    candidates: Candidates,
    members: Int64[np.ndarray, " C"],
    taken: Float32[np.ndarray, "N 3"],
    num: int,
    settings: Settings,
    rng: np.random.Generator,
) -> Int64[np.ndarray, " num"]:
    """Which ``num`` of the members of a tier to take."""
    if settings.spread:
        xyz, footprint = candidates.xyz[members], candidates.footprint[members]
        return spread_points(xyz, footprint, taken, num, rng)
    return _even_shares(candidates.image_idx[members], num, rng)


def _even_shares(
    image_idx: Int32[np.ndarray, " C"], num: int, rng: np.random.Generator
) -> Int64[np.ndarray, " num"]:
    """``num`` of C indices, as many of every image as it and the others have."""
    order = rng.permutation(len(image_idx))
    order = order[np.argsort(image_idx[order], kind="stable")]
    counts = np.bincount(image_idx)
    place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    # The first of every image, then the second of every image, and so on.
    return np.asarray(order[np.argsort(place, kind="stable")[:num]])


def _tiers(
    views: Sequence[View], settings: Settings, progress: Progress
) -> list[UInt8[np.ndarray, " C"]]:
    """The tiers of every view's candidates."""
    if not settings.compares_views:
        return [np.where(view.edge, NEAR_EDGE, SOUND).astype(np.uint8) for view in views]
    neighbors = choose_neighbors(views, settings.num_neighbors)
    tiers: list[UInt8[np.ndarray, " C"]] = [np.empty(0, np.uint8)] * len(views)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            asked = [views[j] for j in neighbors[i] if j >= 0]
            tiers[i] = _tier(views[i], find_support(views[i], asked, settings), settings)

    in_threads(work, len(views), 1, "compare views", progress)
    return tiers


def _tier(view: View, support: Support, settings: Settings) -> UInt8[np.ndarray, " C"]:
    tier = np.where(support.agreeing >= settings.min_agreeing, SOUND, UNCONFIRMED)
    tier[view.edge] = NEAR_EDGE
    if not settings.see_through:
        tier[support.seen_through] = DISTRUSTED
    return tier.astype(np.uint8)
