"""Depth-guided lifting, from the images of a scene to new points.

Notation: every image gives *candidates*, C in all; a candidate is *sound* (``tier`` 0) if enough
views confirm it, none looks through it, and no depth discontinuity is near. To spread points, space
is cut into cubes of one *side*; the key of a cube is its position, three numbers of 21 bits,
scrambled so that all its bits are as good as random.
Promise: exactly the number asked for, or one error that says how many are possible. Sound
candidates come first, then those that too few views confirm, then those near discontinuities; none
that a view looks through is used, unless that is allowed. A note says how many of the less certain
ones were needed. Within one tier, points are spread evenly in space, or every image gives the same
number as far as it can. Each cube gives at most one candidate, the one with the finest footprint,
and none if an original lies in it; the side is the largest that gives the number, to about a
fiftieth; the result does not depend on threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8, UInt64

from splatseed.depth.alignment import Settings, lift_pixels, reject_outliers
from splatseed.depth.comparison import choose_neighbors, find_support, synchronize_scales
from splatseed.depth.views import DepthView, read_view
from splatseed.errors import PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.io.photograph import photograph_folder
from splatseed.io.photograph_checks import with_photographs
from splatseed.photos.visibility import find_visibility
from splatseed.progress import Progress, in_threads, silent
from splatseed.runtime.hashing import scramble
from splatseed.runtime.jit import kernel, parallel_range
from splatseed.scene import Image, Scene
from splatseed.text import agreeing

SOUND, UNCONFIRMED, NEAR_EDGE, DISTRUSTED = range(4)
"""Tiers, in the order in which they are used up; the last is never used."""
OVERSAMPLING = 1.4
"""Candidates per new point, when views are compared or points spread."""
MAX_OVERSAMPLING, MAX_GROWTH = 16.0, 8.0
"""Most candidates per new point, and the most by which a round of reading multiplies them."""
SURPLUS = 1.25
"""Candidates are overdrawn by this factor, to save another round."""
NAMED = 3
"""Most images that a note names."""
PIECE = 4
"""Views per task of a thread."""
PARTS, SAMPLED, FEW = 32, 2, 1 << 16
"""Parts of the hash range, by a key's top 5 bits; those whose cubes are counted to find the side,
unless there are few candidates."""
STEPS = 24
"""Most trials of a side."""
LEAST_POWER = 0.2
"""Least exponent e assumed in: number of cubes ~ (1 / side)^e; bounds the length of a step."""
SLACK = 0.02
"""Surplus of cubes that is accepted: it is then dropped at random."""
BITS = 21
"""Bits of a cube's position along one axis: three fit into 64."""
OUTSIDE = 2.0**20 + 2
"""Positions beyond every cube of a candidate, as no side is below ``FINEST``."""
FINEST = 2.0**-20
"""The smallest side, as a fraction of the candidates' extent: positions fit into the bits."""


def lift(
    scene: Scene,
    num: int,
    settings: Settings,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> tuple[Float32[np.ndarray, "M 3"], UInt8[np.ndarray, "M 3"], tuple[str, ...]]:
    """Lift ``num`` pixels of a scene's images into its world.

    Each image and its map are read once, and again only if too few of the candidates are sound.
    Returns world positions and colours, image after image, and what was left out or replaced, one
    sentence each.

    Raises:
        SceneNotFoundError: There are no maps or no photographs, or a file is gone.
        SceneFormatError: A file is damaged or does not fit, or no map can be aligned.
        PointCloudError: The maps cannot give so many points.
    """
    scene, center = _centered(scene)
    depths, visibility = scene.depths, find_visibility(scene)
    used = scene.images
    if settings.test_every or scene.listed:
        used = scene.split(settings.test_every)[0]
    images = [image for image in used if depths is not None and image.name in depths]
    if depths is None or not images:
        raise SceneNotFoundError(
            "a scene with depth maps of its images",
            found=f"{len(scene.images)} images, and maps of none of them",
            fix="Name the folder with the maps: --depth DIR.",
        )
    folder, notes, there = (
        photograph_folder(scene),
        [],
        {i.name for i in with_photographs(scene).images},
    )
    images = [image for image in images if image.name in there]
    if lacking := sum(image.name not in depths for image in used):
        what = agreeing(lacking, "has no depth map and gives", "have no depth map and give")
        notes.append(f"{lacking} of {len(used)} images {what} no points.")

    def read_all(num: float) -> list[DepthView]:
        """The views of all images, which share the number of candidates equally."""
        views: dict[int, DepthView] = {}
        # One seed per image, drawn in order, so that threads do not matter.
        seeds = rng.integers(0, 1 << 63, len(images))

        def work(start: int, stop: int) -> None:
            for i in range(start, stop):
                own, share = np.random.default_rng(seeds[i]), math.ceil(num / len(images))
                views[i] = read_view(
                    images[i], folder, scene.masks, depths, visibility, settings, share, own,
                    scene.white,
                )  # fmt: skip

        in_threads(work, len(images), 1, "read images", progress)
        return [views[i] for i in range(len(images))]

    factor = OVERSAMPLING if settings.compares_views or settings.spread else SURPLUS
    views = read_all(factor * num)
    images, views = _leave_out(images, views, settings.max_residual_ratio, notes)
    candidates = _gather(views, settings, progress)
    while (
        (sound := int(np.count_nonzero(candidates.tier == SOUND))) < num
        and factor < MAX_OVERSAMPLING
        and not all(v.exhausted for v in views)
    ):
        # In proportion to what was sound, so that one more round mostly suffices.
        growth = SURPLUS * num / max(sound, 1)
        factor = min(factor * min(growth, MAX_GROWTH), MAX_OVERSAMPLING)
        views = read_all(factor * num)
        candidates = _gather(views, settings, progress)
    progress("choose points", 0.0)
    points = scene.points.originals
    chosen = _choose(candidates, np.asarray(points.xyz[points.finite]), num, settings, rng)
    progress("choose points", 1.0)
    tier = candidates.tier[chosen]
    if unconfirmed := np.count_nonzero(tier == UNCONFIRMED):
        notes.append(
            f"{unconfirmed:,} of {num:,} new points are confirmed by fewer than "
            f"{settings.min_agreeing} other views: no others were left."
        )
    if edge := np.count_nonzero(tier == NEAR_EDGE):
        notes.append(f"{edge:,} of {num:,} new points lie near depth discontinuities.")
    xyz = candidates.xyz[chosen]
    np.add(xyz, center, out=xyz, casting="same_kind")  # in float64, then rounded
    return xyz, candidates.rgb[chosen], tuple(notes)


def _centered(scene: Scene) -> tuple[Scene, Float64[np.ndarray, " 3"]]:
    """The scene with the mean of its cameras moved to the origin, and that mean.

    Candidates are float32, which far from the origin (UTM coordinates) would be too coarse to
    compare.
    """
    if not scene.images:
        return scene, np.zeros(3)
    center = np.mean([image.camera.center for image in scene.images], axis=0)
    images = tuple(
        replace(image, translation=image.translation + image.camera.cam_from_world[:3, :3] @ center)
        for image in scene.images
    )
    points = scene.points.replace(xyz=(scene.points.xyz - center).astype(np.float32))
    return scene.replace(points=points, images=images, tracks=scene.tracks), center


def _leave_out(
    images: list[Image], views: list[DepthView], max_ratio: float | None, notes: list[str]
) -> tuple[list[Image], list[DepthView]]:
    """The images and views whose maps are aligned; a note is added on the others."""
    alignments = reject_outliers(
        {image.name: view.alignment for image, view in zip(images, views, strict=True)}, max_ratio
    )
    reasons = {name: a.rejected for name, a in alignments.items() if a.rejected is not None}
    if len(reasons) == len(alignments):
        name, reason = next(iter(reasons.items()))
        raise SceneFormatError(
            "depth maps that fit the SfM points of their images",
            found=f"none among {len(images)}; {name}: {reason}",
            fix="Look at them with splatseed info SCENE --depth DIR; check --depth-kind and "
            "--depth-scale.",
        )
    if reasons:
        named = "; ".join(f"{name}: {reason}" for name, reason in list(reasons.items())[:NAMED])
        more = ", ..." if len(reasons) > NAMED else ""
        notes.append(f"{len(reasons)} of {len(images)} depth maps are left out ({named}{more}).")
    kept = [i for i, image in enumerate(images) if image.name not in reasons]
    return [images[i] for i in kept], [views[i] for i in kept]


class _Candidates(NamedTuple):
    """Points that could be added, view after view."""

    xyz: Float32[np.ndarray, "C 3"]
    rgb: UInt8[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]  # size of a pixel at their depth, scene units
    tier: UInt8[np.ndarray, " C"]
    view_idx: Int64[np.ndarray, " C"]


def _gather(views: Sequence[DepthView], settings: Settings, progress: Progress) -> _Candidates:
    """Lift the views' candidates, and compare them with other views if the settings say so."""
    counts = np.array([len(view) for view in views])
    neighbors = choose_neighbors(views, settings.num_neighbors, progress)
    factors = np.ones(len(views))
    if settings.synchronizes:
        factors = synchronize_scales(views, neighbors, progress)
    copies = [
        view.reduced and view.reduced._replace(factor=view.reduced.factor * factor)
        for view, factor in zip(views, factors.tolist(), strict=True)
    ]
    stop_of = np.cumsum(counts)
    candidates = _Candidates(
        np.empty((stop_of[-1], 3), np.float32),
        np.concatenate([view.rgb for view in views]),
        np.empty(stop_of[-1], np.float32),
        np.empty(stop_of[-1], np.uint8),
        np.repeat(np.arange(len(views)), counts),
    )

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            view, own, factor = views[i], copies[i], float(factors[i])
            xyz, _, footprint, tier, _ = (
                each[stop_of[i] - counts[i] : stop_of[i]] for each in candidates
            )
            xyz[:] = lift_pixels(view.pixel, view.z, view.camera, factor)
            # A pixel at depth z is z / focal wide.
            np.multiply(view.z, factor / view.camera.K[0, 0], out=footprint)
            tier[:] = SOUND
            seen_through: Bool[np.ndarray, " C"] | None = None
            if settings.compares_views and own is not None:
                asked = [copy for j in neighbors[i] if j >= 0 and (copy := copies[j]) is not None]
                confirming, seen_through = find_support(xyz, own, asked, settings)
                tier[confirming < settings.min_agreeing] = UNCONFIRMED
            tier[view.edge] = NEAR_EDGE  # the worst tier counts
            if seen_through is not None and not settings.see_through:
                tier[seen_through] = DISTRUSTED

    in_threads(work, len(views), PIECE, "compare views", progress)
    return candidates


def _choose(
    candidates: _Candidates,
    originals: Float32[np.ndarray, "N 3"],
    num: int,
    settings: Settings,
    rng: np.random.Generator,
) -> Int64[np.ndarray, " num"]:
    """Exactly ``num`` candidates, ascending indices, beside originals that exist already."""
    usable = int(np.count_nonzero(candidates.tier < DISTRUSTED))
    if usable < num:
        larger = " or a larger --depth.region" if settings.region < 1 else ""
        raise PointCloudError(
            f"depth maps that can give {num:,} points",
            found=f"{usable:,} that no other view looks through" if usable else "none",
            fix=f"Ask for fewer, or allow more with --depth.see-through{larger}.",
        )
    taken = np.zeros(len(candidates.tier), bool)
    for tier in range(DISTRUSTED):
        members, missing = candidates.tier == tier, num - int(np.count_nonzero(taken))
        if missing >= np.count_nonzero(members):
            taken |= members
        elif settings.spread:
            there = np.concatenate([originals, candidates.xyz[taken]])
            xyz, footprint = candidates.xyz, candidates.footprint
            return np.flatnonzero(taken | thin(xyz, footprint, members, there, missing, rng))
        else:
            which = np.flatnonzero(members)
            taken[which[_even_shares(candidates.view_idx[which], missing, rng)]] = True
            break
    return np.flatnonzero(taken)


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


def thin(
    xyz: Float32[np.ndarray, "C 3"],
    footprint: Float32[np.ndarray, " C"],
    eligible: Bool[np.ndarray, " C"],
    originals: Float32[np.ndarray, "N 3"],
    num: int,
    rng: np.random.Generator,
) -> Bool[np.ndarray, " C"]:
    """Mark ``num`` of the eligible candidates, one per cube, the finest; none beside an original.

    ``rng`` draws which of a small surplus are dropped, and fills up where candidates coincide.
    """
    cubes = Cubes(xyz, footprint, eligible, originals)
    side = _largest_side(cubes, num)
    taken = cubes.take(side)
    if np.count_nonzero(taken) < num:  # the estimate was a little too large
        taken = cubes.take(side * (1.0 - 2 * SLACK))
    surplus = np.count_nonzero(taken) - num
    if surplus > 0:
        taken[rng.choice(np.flatnonzero(taken), surplus, replace=False, shuffle=False)] = False
    else:
        rest = np.flatnonzero(eligible & ~taken)
        taken[rng.choice(rest, -surplus, replace=False, shuffle=False)] = True
    return taken


def _largest_side(cubes: Cubes, num: int) -> float:
    """The largest side at which about ``num`` cubes hold a candidate."""
    extent = float(np.ptp(cubes.xyz.astype(np.float64), axis=0).max()) or 1.0
    least, most = FINEST * extent, extent
    side, power = extent / math.sqrt(num), 2.0  # points on surfaces; fewer when saturated
    known: tuple[float, float] | None = None
    for _ in range(STEPS):
        count = max(cubes.count(side), 1.0)
        if num <= count <= num * (1.0 + SLACK):
            return side
        least, most = (side, most) if count > num else (least, side)
        if known is not None and count != known[1]:
            power = math.log(count / known[1]) / math.log(known[0] / side)
        known = side, count
        # Secant step in log side: count ~ side^-power, aimed at the middle of the slack.
        guess = side * (count / (num * (1.0 + 0.5 * SLACK))) ** (1.0 / max(power, LEAST_POWER))
        # A step out of the bracket is replaced by bisection, in log side.
        side = guess if least < guess < most else math.sqrt(least * most)
    return least


@dataclass(frozen=True, eq=False)
class Cubes:
    """Candidates and originals, sorted into cubes of any side; arguments as ``thin`` has them."""

    xyz: Float32[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]
    eligible: Bool[np.ndarray, " C"]
    originals: Float32[np.ndarray, "N 3"]

    def count(self, side: float) -> float:
        """Estimate how many cubes hold a candidate and no original."""
        parts = PARTS if len(self.xyz) < FEW else SAMPLED
        keys, blocked = self._keys(side)
        some = keys[self.eligible & (keys >> np.uint64(59) < parts)]
        return len(np.setdiff1d(some, blocked)) * (PARTS / parts)

    def take(self, side: float) -> Bool[np.ndarray, " C"]:
        """Mark the candidate that each cube gives: the finest, of equals the first."""
        keys, blocked = self._keys(side)
        candidates = np.flatnonzero(self.eligible & ~np.isin(keys, blocked))
        order = candidates[np.lexsort((self.footprint[candidates], keys[candidates]))]
        taken = np.zeros(len(keys), np.bool_)
        taken[order[np.unique(keys[order], return_index=True)[1]]] = True
        return taken

    def _keys(self, side: float) -> list[UInt64[np.ndarray, " C"]]:
        """The keys of the candidates' cubes, and of the originals'."""
        low = self.xyz.min(axis=0).astype(np.float64)
        keys = [np.empty(len(points), np.uint64) for points in (self.xyz, self.originals)]
        _find_cubes(self.xyz, low, side, keys[0])
        _find_cubes(self.originals, low, side, keys[1])
        return keys


@kernel
def _find_cubes(xyz, low, side, out):  # type: ignore[no-untyped-def]  # Numba's types
    """The key of each point's cube.

    Points outside the candidates' box get keys that no other cube has.
    """
    for k in parallel_range(len(xyz)):
        key = np.uint64(0)
        for axis in range(3):
            place = np.floor((np.float64(xyz[k, axis]) - low[axis]) / side)
            inside = min(max(place, -1.0), OUTSIDE)
            key = (key << np.uint64(BITS)) | np.uint64(inside + 1.0)
        out[k] = scramble(key)
