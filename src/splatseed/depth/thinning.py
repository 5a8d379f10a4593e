"""Spread points in space: keep one candidate per cube, the finest, of the largest suitable side.

Notation: space is divided into cubes of one *side*; the key of a cube is its position, three
numbers of 21 bits, scrambled so that any of its bits are as good as random. Promise: each cube
gives at most one candidate, the one with the finest footprint, and none if an original lies in it.
The side is the largest that gives the number, to about 2%.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt64

from splatseed.depth._kernels import cube_keys


@dataclass(frozen=True)
class _Search:
    """Search of the side of the cubes."""

    num_parts: int = 32  # parts of the hash range, by the top 5 bits of a key
    num_counted: int = 2  # parts whose cubes are counted where there are many candidates
    few: int = 1 << 16  # candidates up to which all cubes are counted
    max_steps: int = 24
    min_power: float = 0.2  # smallest e in: number of cubes ~ side^-e; bounds a step's length
    surplus: float = 0.02  # cubes more than wanted that are accepted; dropped at random
    min_side: float = 2.0**-20  # relative to the candidates' extent: positions fit into 21 bits


SEARCH = _Search()


def spread_evenly(
    xyz: Float32[np.ndarray, "C 3"],
    footprint: Float32[np.ndarray, " C"],
    eligible: Bool[np.ndarray, " C"],
    originals: Float32[np.ndarray, "N 3"],
    num: int,
    rng: np.random.Generator,
) -> Bool[np.ndarray, " C"]:
    """Mark ``num`` of the eligible candidates, one per cube, the finest; none near an original.

    ``rng`` drops a small surplus, and fills up where candidates coincide.
    """
    cubes = Cubes(xyz, footprint, eligible, originals)
    side = _largest_side(cubes, num)
    taken = cubes.take(side)
    if np.count_nonzero(taken) < num:  # the estimate was a little too large
        taken = cubes.take(side * (1.0 - 2 * SEARCH.surplus))
    surplus = np.count_nonzero(taken) - num
    if surplus > 0:
        taken[rng.choice(np.flatnonzero(taken), surplus, replace=False, shuffle=False)] = False
    else:
        rest = np.flatnonzero(eligible & ~taken)
        taken[rng.choice(rest, -surplus, replace=False, shuffle=False)] = True
    return taken


def _largest_side(cubes: Cubes, num: int) -> float:
    """Find the largest side at which about ``num`` cubes hold a candidate."""
    extent = float(np.ptp(cubes.xyz.astype(np.float64), axis=0).max()) or 1.0
    low, high = SEARCH.min_side * extent, extent
    side, power = extent / math.sqrt(num), 2.0  # points on surfaces; fewer when saturated
    known: tuple[float, float] | None = None
    for _ in range(SEARCH.max_steps):
        count = max(cubes.count(side), 1.0)
        if num <= count <= num * (1.0 + SEARCH.surplus):
            return side
        low, high = (side, high) if count > num else (low, side)
        if known is not None and count != known[1]:
            power = math.log(count / known[1]) / math.log(known[0] / side)
        known = side, count
        # Secant step in log side: count ~ side^-power, aimed at the middle of the surplus.
        target = num * (1.0 + 0.5 * SEARCH.surplus)
        guess = side * (count / target) ** (1.0 / max(power, SEARCH.min_power))
        # A step out of the bracket is replaced by bisection, in log side.
        side = guess if low < guess < high else math.sqrt(low * high)
    return low


@dataclass(frozen=True, eq=False)
class Cubes:
    """Candidates and originals sorted into cubes of any side; arguments as in ``spread_evenly``."""

    xyz: Float32[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]
    eligible: Bool[np.ndarray, " C"]
    originals: Float32[np.ndarray, "N 3"]

    def count(self, side: float) -> float:
        """Estimate how many cubes hold a candidate and no original."""
        parts = SEARCH.num_parts if len(self.xyz) < SEARCH.few else SEARCH.num_counted
        keys, blocked = self._keys(side)
        counted = keys[self.eligible & (keys >> np.uint64(59) < parts)]
        return len(np.setdiff1d(counted, blocked)) * (SEARCH.num_parts / parts)

    def take(self, side: float) -> Bool[np.ndarray, " C"]:
        """Mark the candidate of each cube: the finest; of equals the first."""
        keys, blocked = self._keys(side)
        candidates = np.flatnonzero(self.eligible & ~np.isin(keys, blocked))
        order = candidates[np.lexsort((self.footprint[candidates], keys[candidates]))]
        taken = np.zeros(len(keys), np.bool_)
        taken[order[np.unique(keys[order], return_index=True)[1]]] = True
        return taken

    def _keys(self, side: float) -> list[UInt64[np.ndarray, " C"]]:
        low = self.xyz.min(axis=0).astype(np.float64)
        keys = [np.empty(len(points), np.uint64) for points in (self.xyz, self.originals)]
        cube_keys(self.xyz, low, side, keys[0])
        cube_keys(self.originals, low, side, keys[1])
        return keys
