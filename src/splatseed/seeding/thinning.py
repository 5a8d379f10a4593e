"""Thinning: which points a budget keeps.

Notation: N points, of which ``num`` are kept. The views that see a point most closely are the
``CLOSEST`` in which its depth / focal length is smallest. With a *spacing* of s pixels, a view is
cut into cells of s x s pixels, and its depth into slices of 4 times that. A point is *needed* at a
spacing if, in the view that sees it most closely, its cell holds no kept point.

Promise: points are visited in order, originals first, then by priority. Each is kept if it is
needed at the smallest spacing that keeps no more than ``num``; smaller spacings fill the rest. So
the only point of a cell is kept before the second of another. But of originals alone every n-th is
kept: Structure-from-Motion finds them in proportion to detail, where Gaussians are needed; kept
evenly over the pictures they train to a lower SSIM (benchmarks/tried.md). Nothing is
random, and bytes do not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from splatseed.errors import ParameterError, PointCloudError
from splatseed.frozen import read_only_view
from splatseed.io.regions import Region
from splatseed.methods import Upsampler, source_code
from splatseed.photos.view import View
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.seeding._kernels import thinning as kernels
from splatseed.seeding.cover import kernel_points
from splatseed.seeding.photo_methods import (
    CELL,
    MAX_SIZE,
    frames_of,
    photographed,
    read_views,
    with_cover,
)

COVER, CLOUD = source_code("cover"), source_code("cloud")
MIN_COVER_SHARE = 0.1
"""Part of a budget that cover's seeds may always use."""
COVER_GROWTH = 1.25
"""Factor by which cover's cells grow until their seeds fit."""
CLOSEST = 4
"""Views in which a kept point is marked: enough for neighbours to share one, few enough to be
quick."""
FINEST, COARSEST = 1.0 / 16, 1 << 14
"""Range of spacings, in pixels."""
TOLERANCE = 0.02
"""Share of ``num`` by which the points kept at one spacing may fall short."""
MAX_STEPS = 24
"""Spacings tried."""
MIN_EXPONENT = 0.2
"""Smallest exponent e assumed in number kept ~ (1 / spacing)^e, which bounds a step; 2 on
surfaces."""
NOMINAL_WIDTH = 4096.0
"""Width of a cloud without views, in pixels."""
QUANTILE = 0.01
"""Share of the points on either side that may lie outside of that width."""
FARTHEST = 2.0**30
"""Limit of their coordinates, in pixels."""


def thin_to(
    scene: Scene,
    cloud: PointCloud,
    num: int,
    method: Upsampler | None,
    seed: int,
    progress: Progress,
    *,
    cell: int | None = None,
    region: Region | None = None,
    beyond: PointCloud | None = None,
) -> PointCloud:
    """Keep at most ``num`` points, originals before others of equal use.

    With ``num`` or more originals only originals stay: they are dense where there is detail, where
    Gaussians are needed most. But points of a scan are thinned together with them. Cover's seeds
    are guesses that must not replace a measured point, so they are made again for the points that
    are kept, with cells of at least ``cell`` pixels (by default the method's own), in the region
    if there is one, and such that they fit the points ``beyond`` it.
    """
    if len(cloud) <= num:
        return cloud
    points = cloud.select(cloud.distinct)
    if points.num_original >= num and not (points.source == CLOUD).any():
        return _keep(scene, points.originals, num)
    is_cover = points.source == COVER
    if not is_cover.any() or is_cover.all():
        return _keep(scene, points, num)
    measured = points.select(~is_cover)
    images = photographed(scene, getattr(method, "test_every", 0))
    views = read_views(scene, images, getattr(method, "max_size", MAX_SIZE), progress)
    cell = cell or int(getattr(method, "cell", CELL))
    # Cover gets the room that measured points leave, and a tenth of the budget at least.
    room = max(num - len(measured), round(MIN_COVER_SHARE * num))
    kept = _keep(scene, measured, num - room)
    while cell <= MAX_SIZE:
        known = kept if beyond is None else PointCloud.concatenate(kept, beyond)
        filled = with_cover(views, known, cell, seed, progress).select(slice(len(known), None))
        filled = filled if region is None else filled.select(region(filled.xyz))
        if len(filled) <= room:
            return PointCloud.concatenate(_keep(scene, measured, num - len(filled)), filled)
        cell = math.ceil(COVER_GROWTH * cell)
    return _keep(scene, measured, num)


def _keep(scene: Scene, points: PointCloud, num: int) -> PointCloud:
    """Keep at most ``num`` points by the views that see them."""
    if len(points) <= num or num < 1:
        return points.select(slice(max(num, 0)))
    first = int(np.count_nonzero(points.source == ORIGINAL))
    kept = thin(points.xyz, frames_of(scene), num, first=first, priority=points.confidence)
    return points.select(kept)


def thin(
    xyz: Float32[np.ndarray, "N 3"],
    views: Sequence[View],
    num: int,
    *,
    first: int = 0,
    priority: Float[np.ndarray, " N"] | None = None,
) -> Int64[np.ndarray, " num"]:
    """Choose the points to keep: ascending indices, min(num, N) of them.

    Args:
        xyz: Positions in the world.
        views: Views whose cameras and sizes are used. Without views, cells are cubes in space.
        num: Number of points to keep, at least 1.
        first: Number of originals, which come before the other points.
        priority: Among originals, and among other points, higher ones are visited earlier.
    """
    xyz = kernel_points(xyz)
    if num < 1:
        raise ParameterError("at least 1 point to keep", found=f"{num}", fix="Ask for more.")
    places = _places_in_views(xyz, views) if views else _places_in_space(xyz)
    order = _order(len(xyz), first, priority)
    if len(xyz) <= num:
        return np.arange(len(xyz))
    if views and first == len(xyz):
        seen = np.argsort(places.group[:, 0] < 0, stable=True)
        candidates = max(num, int(np.count_nonzero(places.group[:, 0] >= 0)))
        return np.sort(seen[np.arange(num) * candidates // num])
    kept, spacing = _keep_at_one_spacing(places, order, num)
    while spacing > FINEST and np.count_nonzero(kept) < num:
        spacing /= 2
        places.keep(order, spacing, num, kept)
    rest = order[~kept[order]]  # they coincide with others, or no view sees them
    rest = rest[np.argsort(places.group[rest, 0] < 0, stable=True)]
    kept[rest[: num - np.count_nonzero(kept)]] = True
    return np.flatnonzero(kept)


def _order(
    num: int, first: int, priority: Float[np.ndarray, " N"] | None
) -> Int64[np.ndarray, " N"]:
    """Return the order in which points are visited: originals first, then by priority."""
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
    """Positions of points in the views that see them most closely."""

    group: Int32[np.ndarray, "N k"]  # the views, closest first; -1 where there are no more
    place: Float32[np.ndarray, "N k 3"]  # column, row and slice of depth in pixels

    def keep(
        self,
        order: Int64[np.ndarray, " N"],
        spacing: float,
        limit: int,
        kept: Bool[np.ndarray, " N"],
    ) -> int:
        """Keep more points, up to ``limit`` in all; return the number kept."""
        slots = 1 << int(2 * limit * self.group.shape[1]).bit_length()  # at most half full
        return int(kernels.keep(order, self.group, self.place, spacing, limit, slots, kept))


def _keep_at_one_spacing(
    places: _Places, order: Int64[np.ndarray, " N"], num: int
) -> tuple[Bool[np.ndarray, " N"], float]:
    """Keep points at the smallest spacing that keeps at most ``num``; also return the spacing."""
    best = np.zeros(len(order), np.bool_)
    low, high = FINEST, float(COARSEST)
    target, spacing, power = (1.0 - TOLERANCE / 2) * num, 2.0, 2.0
    known: tuple[float, float] | None = None
    for _ in range(MAX_STEPS):
        kept = np.zeros(len(order), np.bool_)
        limit = min(2 * num, len(order))
        count = places.keep(order, spacing, limit, kept)
        if count > num:
            low = spacing
        else:
            best, high = kept, spacing
            if count >= (1.0 - TOLERANCE) * num or spacing == FINEST:
                break
        if count < limit:  # else counting stopped early
            if known is not None and count != known[1]:
                power = math.log(count / known[1]) / math.log(known[0] / spacing)
            known = spacing, count
        guess = max(spacing * (count / target) ** (1.0 / max(power, MIN_EXPONENT)), FINEST)
        inside = low < guess < high or (guess == low == FINEST)
        spacing = guess if inside else math.sqrt(low * high)
    return best, high


def _places_in_space(xyz: Float32[np.ndarray, "N 3"]) -> _Places:
    """Scale the cloud, without its outliers, to ``NOMINAL_WIDTH`` pixels in place of views."""
    finite = np.isfinite(xyz).all(axis=1)
    inside = xyz[finite].astype(np.float64)
    place = np.zeros((len(xyz), 1, 3), np.float32)
    if len(inside):
        # Between its hundredths: one point far away must not put all others into one cell.
        low, high = np.quantile(inside, [QUANTILE, 1 - QUANTILE], axis=0)
        extent = (high - low).max() or np.ptp(inside, axis=0).max() or 1.0
        place[finite, 0] = np.clip((inside - low) * (NOMINAL_WIDTH / extent), -FARTHEST, FARTHEST)
    return _Places(np.where(finite, 0, -1).astype(np.int32)[:, None], place)


def _places_in_views(xyz: Float32[np.ndarray, "N 3"], views: Sequence[View]) -> _Places:
    """Find the views that see each point most closely, and its position in them."""
    matrices = np.stack([view.camera.cells_from_world(1) for view in views])
    focals = np.array([np.sqrt(abs(view.K[0, 0] * view.K[1, 1])) for view in views])
    sizes = np.array([[view.width, view.height] for view in views], np.float64)
    shape = len(xyz), min(CLOSEST, len(views))
    group, place = np.full(shape, -1, np.int32), np.zeros((*shape, 3), np.float32)
    kernels.find_closest(read_only_view(xyz), matrices, focals, sizes, group, place)
    return _Places(group, place)
