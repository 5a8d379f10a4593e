"""A budget: how many seeds there may be, and which are kept if there are more.

Notation: N points, of which ``num`` are kept. The views that see a point most closely are the
``CLOSEST`` ones in whose frame it falls at the smallest depth / focal length. With a *spacing* of
s pixels, a view's frame is cut into cells of s x s pixels, and its depth into slices of ``DEEP``
times that. A point is *needed* at a spacing if, in the view that sees it most closely, no kept
point lies in its cell.
Promise: points are visited in order, the originals first and then by priority; each is kept if it
is needed, at the smallest spacing that keeps no more than ``num``; the remainder is filled up at
smaller spacings. So the only point of a cell is kept before the second of any. But where views see
originals alone, every n-th is kept: Structure-from-Motion finds them in proportion to detail, which
is where Gaussians are needed; kept evenly over the pictures they train to a lower SSIM
(benchmarks/training/README.md). Nothing is random, and the bytes do not depend on the threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from splatseed.errors import ParameterError, PointCloudError
from splatseed.photos._kernels import project_block
from splatseed.photos.projection import cells_from_world
from splatseed.photos.view import View
from splatseed.runtime.hashing import FREE, scramble, slot_of
from splatseed.runtime.jit import inline, kernel, parallel_range
from splatseed.seeding.coverage import check_points

CLOSEST = 4
"""Views in which a kept point is marked: enough for neighbours to share one, few enough to be
quick."""
DEEP = 4.0  # slices of depth, in cells: deep enough that noise along the ray makes no new cell
CHUNKS = 64
BLOCK = 512
FINEST, COARSEST = 1.0 / 16, 1 << 14  # range of spacings that are tried, in pixels
CLOSE_ENOUGH = 0.02  # by how many points a spacing may fall short of the number
STEPS = 24
LEAST_POWER = 0.2
"""Least exponent e assumed in: number kept ~ (1 / spacing)^e; bounds a step. On surfaces e is 2."""
ACROSS = 4096.0  # nominal width in pixels of a cloud without views
MIDDLE, FARTHEST = 0.01, 2.0**30  # the share beyond that width on either side; how far it counts


def median_pixels(views: Sequence[View]) -> float:
    """The number of pixels of the median view; ParameterError if there is none."""
    if not views:
        raise ParameterError(
            "images, for a budget in rho", found="none", fix="Give a number of seeds instead."
        )
    return float(np.median([view.width * view.height for view in views]))


def thin(
    xyz: Float32[np.ndarray, "N 3"],
    views: Sequence[View],
    num: int,
    *,
    first: int = 0,
    priority: Float[np.ndarray, " N"] | None = None,
) -> Int64[np.ndarray, " num"]:
    """Which points to keep: indices, rising, min(num, N).

    Args:
        xyz: The points, in the world.
        views: Only their cameras and sizes matter. Without any, cells are cubes in space.
        num: How many to keep, at least 1.
        first: How many of the points are originals, which stand before the others.
        priority: Higher ones are visited earlier, among originals and among the others; equal ones
            in their order.

    Raises:
        ParameterError: ``num`` is below 1.
        PointCloudError: ``xyz`` is not of shape [N, 3], or ``priority`` not of shape [N].
    """
    xyz = check_points(views, xyz, 1) if views else _check_bare(xyz)
    if num < 1:
        raise ParameterError("at least 1 point to keep", found=f"{num}", fix="Ask for more.")
    places = _places_in_views(xyz, views) if views else _places_in_space(xyz)
    order = _order(len(xyz), first, priority)
    if len(xyz) <= num:
        return np.arange(len(xyz))
    if views and first == len(xyz):
        seen = np.argsort(places.group[:, 0] < 0, stable=True)
        most = max(num, int(np.count_nonzero(places.group[:, 0] >= 0)))
        return np.sort(seen[np.arange(num) * most // num])
    kept, spacing = _keep_at_one_spacing(places, order, num)
    while spacing > FINEST and np.count_nonzero(kept) < num:
        spacing /= 2
        places.keep(order, spacing, num, kept)
    rest = order[~kept[order]]  # they coincide with others, or no view sees them
    rest = rest[np.argsort(places.group[rest, 0] < 0, stable=True)]
    kept[rest[: num - np.count_nonzero(kept)]] = True
    return np.flatnonzero(kept)


def _check_bare(xyz: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    return check_points((None,), xyz, 1)  # type: ignore[arg-type]  # no view is looked at


def _order(
    num: int, first: int, priority: Float[np.ndarray, " N"] | None
) -> Int64[np.ndarray, " N"]:
    """The points in the order in which they are visited."""
    if priority is None:
        return np.arange(num)
    priority = np.asarray(priority, np.float64)
    if priority.shape != (num,):
        raise PointCloudError(
            f"priority of shape [{num}]",
            found=f"{list(priority.shape)}",
            fix="Pass one number per point, or leave it out.",
        )
    return np.lexsort((-priority, np.arange(num) >= first))  # stable


@dataclass(frozen=True, eq=False)
class _Places:
    """Where points lie in the views that see them most closely."""

    group: Int32[np.ndarray, "N k"]  # the views, closest first; -1 where there are no more
    place: Float32[np.ndarray, "N k 3"]  # column, row and slice of depth in pixels

    def keep(
        self,
        order: Int64[np.ndarray, " N"],
        spacing: float,
        limit: int,
        kept: Bool[np.ndarray, " N"],
    ) -> int:
        """Keep more points, up to ``limit`` in all, and return how many are kept then."""
        slots = 1 << int(2 * limit * self.group.shape[1]).bit_length()  # at most half full
        return int(_keep(order, self.group, self.place, spacing, limit, slots, kept))


def _keep_at_one_spacing(
    places: _Places, order: Int64[np.ndarray, " N"], num: int
) -> tuple[Bool[np.ndarray, " N"], float]:
    """Which points the smallest spacing with at most ``num`` keeps, and that spacing."""
    best = np.zeros(len(order), np.bool_)
    low, high = FINEST, float(COARSEST)
    target, spacing, power = (1.0 - CLOSE_ENOUGH / 2) * num, 2.0, 2.0
    known: tuple[float, float] | None = None
    for _ in range(STEPS):
        kept = np.zeros(len(order), np.bool_)
        limit = min(2 * num, len(order))
        count = places.keep(order, spacing, limit, kept)
        if count > num:
            low = spacing
        else:
            best, high = kept, spacing
            if count >= (1.0 - CLOSE_ENOUGH) * num or spacing == FINEST:
                break
        if count < limit:  # else counting stopped early
            if known is not None and count != known[1]:
                power = math.log(count / known[1]) / math.log(known[0] / spacing)
            known = spacing, count
        guess = max(spacing * (count / target) ** (1.0 / max(power, LEAST_POWER)), FINEST)
        inside = low < guess < high or (guess == low == FINEST)
        spacing = guess if inside else math.sqrt(low * high)
    return best, high


def _places_in_space(xyz: Float32[np.ndarray, "N 3"]) -> _Places:
    """Places without views: the cloud, but for a few outliers, is ``ACROSS`` pixels wide."""
    finite = np.isfinite(xyz).all(axis=1)
    inside = xyz[finite].astype(np.float64)
    place = np.zeros((len(xyz), 1, 3), np.float32)
    if len(inside):
        # Between its hundredths: one point far away must not put all others into one cell.
        low, high = np.quantile(inside, [MIDDLE, 1 - MIDDLE], axis=0)
        extent = (high - low).max() or np.ptp(inside, axis=0).max() or 1.0
        place[finite, 0] = np.clip((inside - low) * (ACROSS / extent), -FARTHEST, FARTHEST)
    return _Places(np.where(finite, 0, -1).astype(np.int32)[:, None], place)


def _places_in_views(xyz: Float32[np.ndarray, "N 3"], views: Sequence[View]) -> _Places:
    """Places in the views that see a point most closely."""
    matrices = np.stack([cells_from_world(view.camera, 1) for view in views])
    focals = np.array([np.sqrt(abs(view.K[0, 0] * view.K[1, 1])) for view in views])
    sizes = np.array([[view.width, view.height] for view in views], np.float64)
    shape = len(xyz), min(CLOSEST, len(views))
    group, place = np.full(shape, -1, np.int32), np.zeros((*shape, 3), np.float32)
    _find_closest(xyz, matrices, focals, sizes, group, place)
    return _Places(group, place)


@kernel
def _find_closest(xyz, matrices, focals, sizes, group, place):  # type: ignore[no-untyped-def]  # Numba's types
    for c in parallel_range(CHUNKS):
        at = np.empty((3, BLOCK))
        stop = len(xyz) * (c + 1) // CHUNKS
        for start in range(len(xyz) * c // CHUNKS, stop, BLOCK):
            num = min(BLOCK, stop - start)
            closeness = np.zeros((num, group.shape[1]))
            for v in range(len(matrices)):
                project_block(xyz[start : start + num], matrices[v], at)
                for k in range(num):
                    inside = 0.0 <= at[0, k] < sizes[v, 0] and 0.0 <= at[1, k] < sizes[v, 1]
                    close = focals[v] / at[2, k]
                    if inside and closeness[k, -1] < close < np.inf:
                        # the scale of depth: a slice is DEEP cells, z / focal each
                        at[2, k] = np.log(at[2, k]) * focals[v] / DEEP
                        _insert(
                            close, v, at[:, k], closeness[k], group[start + k], place[start + k]
                        )


@inline
def _insert(close, v, at, closeness, group, place):  # type: ignore[no-untyped-def]  # Numba's types
    """Insert a view among the closest; among equals the earlier stays first."""
    k = len(closeness) - 1
    while k > 0 and closeness[k - 1] < close:
        closeness[k], group[k], place[k] = closeness[k - 1], group[k - 1], place[k - 1]
        k -= 1
    closeness[k], group[k] = close, v
    for axis in range(3):
        place[k, axis] = at[axis]


@inline
def _keep(order, group, place, spacing, limit, slots, kept):  # type: ignore[no-untyped-def]  # Numba's types
    """Mark the points that are needed, in order, besides those already marked."""
    table = np.full(slots, FREE)
    count = 0
    for i in order:
        if kept[i]:
            count += 1
            _mark_cells(group[i], place[i], spacing, table)
    for i in order:
        if count >= limit:
            break
        if not kept[i] and group[i, 0] >= 0:
            key = _key(group[i, 0], place[i, 0], spacing)
            if table[slot_of(key, table)] == FREE:
                kept[i] = True
                count += 1
                _mark_cells(group[i], place[i], spacing, table)
    return count


@inline
def _mark_cells(group, place, spacing, table):  # type: ignore[no-untyped-def]  # Numba's types
    for k in range(len(group)):
        if group[k] >= 0:
            key = _key(group[k], place[k], spacing)
            table[slot_of(key, table)] = key


@inline
def _key(group, place, spacing):  # type: ignore[no-untyped-def]  # Numba's types
    """A 64-bit key for a cell of a view; collisions are not to be expected."""
    key = scramble(np.uint64(group))
    for axis in range(3):
        key = scramble(key ^ np.uint64(np.int64(np.floor(place[axis] / spacing))))
    return max(key, FREE + np.uint64(1))
