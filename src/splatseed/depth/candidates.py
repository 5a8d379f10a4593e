"""The candidates of all images, how far each can be trusted, and the choice among them.

Notation: C candidates; ``tier`` 0 is sound, then come ``UNCONFIRMED``, ``NEAR_EDGE`` and
``DISTRUSTED``. To spread points, space is cut into cubes of one *side*; the key of a cube is its
position, three numbers of 21 bits, scrambled so that all its bits are as good as random.
Promise: a candidate of a higher tier is taken only after all of the lower tiers; within one tier,
points are spread evenly in space, or every image gives the same number as far as it can. Each cube
gives at most one candidate, the one with the finest footprint, and none if an original lies in it;
the side is the largest that gives the number, to about a fiftieth; the result does not depend on
threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.depth.alignment import lift_pixels
from splatseed.depth.comparison import Support, choose_neighbors, find_support, synchronize_scales
from splatseed.depth.settings import Settings
from splatseed.depth.views import DepthView
from splatseed.errors import PointCloudError
from splatseed.progress import Progress, in_threads
from splatseed.runtime.hashing import scramble
from splatseed.runtime.jit import inline, kernel, parallel_range

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


def gather(views: Sequence[DepthView], settings: Settings, progress: Progress) -> Candidates:
    """Lift the views' candidates, and compare them with other views if the settings say so."""
    counts = np.array([len(view) for view in views])
    neighbors = choose_neighbors(views, settings.num_neighbors, progress)
    factors = np.ones(len(views))
    if settings.synchronizes:
        factors = synchronize_scales(views, neighbors, progress)
    copies = [
        view.reduced and replace(view.reduced, factor=view.reduced.factor * factor)
        for view, factor in zip(views, factors.tolist(), strict=True)
    ]
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


def _fill(candidates: Candidates, mine: slice, view: DepthView, factor: float) -> None:
    """Write a view's candidates into their slice."""
    lift_pixels(view.pixel, view.z, view.camera, candidates.xyz[mine], factor)
    # A pixel at depth z is z / focal wide.
    np.multiply(view.z, factor / view.camera.K[0, 0], out=candidates.footprint[mine])
    candidates.tier[mine][view.edge] = NEAR_EDGE


def _tier(view: DepthView, support: Support, settings: Settings) -> UInt8[np.ndarray, " C"]:
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
    """Choose exactly ``num`` candidates, ascending indices, beside originals that exist already.

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


BUCKETS = 32
"""Parts of the hash range that are processed in parallel."""
SAMPLED = 2
"""Parts used to find the side; all of them if there are few candidates."""
FEW = 1 << 16
"""Candidates below which all parts are counted."""
STEPS = 24
"""Most trials of a side."""
LEAST_POWER = 0.2
"""Least exponent e assumed in: number of cubes ~ (1 / side)^e; bounds the length of a step."""
SLACK = 0.02
"""Surplus of cubes that is accepted: it is then dropped at random."""
EMPTY, BLOCKED = -1, -2
"""Marks an empty slot."""
BITS = 21
"""Bits of a cube's position along one axis: three fit into 64."""
OUTSIDE = 2.0**20 + 2
"""Positions beyond every cube of a candidate, as no side is below ``FINEST``."""
FINEST = 2.0**-20
"""The smallest side, as a fraction of the candidates' extent: positions fit into the bits."""


def thin_by_voxels(
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
    cubes = _Cubes(xyz, footprint, eligible, originals)
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


def _largest_side(cubes: _Cubes, num: int) -> float:
    """The largest side at which about ``num`` cubes hold a candidate."""
    least, most = FINEST * cubes.extent, cubes.extent
    side, power = cubes.extent / math.sqrt(num), 2.0  # points on surfaces; fewer when saturated
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
class _Cubes:
    """Candidates and originals, sorted into cubes of any side."""

    xyz: Float32[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]
    eligible: Bool[np.ndarray, " C"]
    originals: Float32[np.ndarray, "N 3"]

    @cached_property
    def low(self) -> Float64[np.ndarray, " 3"]:
        """The lower corner of the candidates' bounding box."""
        return np.array([column.min() for column in self.xyz.T], np.float64)

    @cached_property
    def extent(self) -> float:
        """The box's longest edge."""
        return float((np.array([column.max() for column in self.xyz.T]) - self.low).max()) or 1.0

    def count(self, side: float) -> float:
        """Estimate how many cubes hold a candidate and no original."""
        buckets = BUCKETS if len(self.xyz) < FEW else SAMPLED
        taken = np.zeros(len(self.xyz), np.bool_)
        count = self._take(side, buckets, taken)
        return count * (BUCKETS / buckets)

    def take(self, side: float) -> Bool[np.ndarray, " C"]:
        """Mark the candidate that each cube gives."""
        taken = np.zeros(len(self.xyz), np.bool_)
        self._take(side, BUCKETS, taken)
        return taken

    def _take(self, side: float, buckets: int, taken: Bool[np.ndarray, " C"]) -> int:
        keys = np.empty(len(self.xyz), np.uint64)
        blocked = np.empty(len(self.originals), np.uint64)
        _find_cubes(self.xyz, self.low, side, keys)
        _find_cubes(self.originals, self.low, side, blocked)
        return int(_take_best(keys, self.eligible, blocked, self.footprint, buckets, taken))


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


@kernel
def _take_best(keys, eligible, blocked, footprint, buckets, taken):  # type: ignore[no-untyped-def]  # Numba's types
    """Mark the finest candidate of every cube in some buckets; returns their number."""
    counts = np.zeros(buckets, np.int64)
    for b in parallel_range(buckets):
        counts[b] = _take_bucket(np.uint64(b), keys, eligible, blocked, footprint, taken)
    return counts.sum()


@inline
def _take_bucket(bucket, keys, eligible, blocked, footprint, taken):  # type: ignore[no-untyped-def]  # Numba's types
    """One bucket, by a hash table with open addressing; the earlier of equals wins."""
    shift = np.uint64(59)  # the top 5 bits: BUCKETS is 32
    size = 0
    for key in keys:
        size += key >> shift == bucket
    for key in blocked:
        size += key >> shift == bucket
    slots = 16
    while slots < 2 * size:
        slots *= 2
    table = np.empty(slots, np.uint64)
    owner = np.full(slots, EMPTY, np.int64)
    for key in blocked:
        if key >> shift == bucket:
            slot = _find(key, table, owner)
            table[slot], owner[slot] = key, BLOCKED
    count = 0
    for k in range(len(keys)):
        if keys[k] >> shift == bucket and eligible[k]:
            slot = _find(keys[k], table, owner)
            if owner[slot] == EMPTY:
                table[slot], owner[slot] = keys[k], k
                count += 1
            elif owner[slot] != BLOCKED and footprint[k] < footprint[owner[slot]]:
                owner[slot] = k
    for slot in range(slots):
        if owner[slot] >= 0:
            taken[owner[slot]] = True
    return count


@inline
def _find(key, table, owner):  # type: ignore[no-untyped-def]  # Numba's types
    """The slot of a key, or the free one where it belongs."""
    last = np.uint64(len(table) - 1)
    slot = key & last
    while owner[slot] != EMPTY and table[slot] != key:
        slot = (slot + np.uint64(1)) & last
    return slot
