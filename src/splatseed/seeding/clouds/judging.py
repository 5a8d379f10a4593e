"""What the photographs see of a cloud, and which of its voxels stay.

Notation: a view's *surface* is the depth of its cells (``photos.zbuffer``), of a side at
which a typical cell holds ``FILLED`` points, so that walls have no holes. A view *sees* points in
front of its surface, and up to ``BEHIND`` of the depth behind it. The *samples* of a point are its
pixels in the ``CLOSEST`` views that see it; their *agreement* is the share within ``ALIKE`` grey
levels of their median, channel by channel. A tracked point of Structure-from-Motion, or a depth of
stereo, proves that the ray to it is free: a cloud point in the same cell of the same view, clearly
nearer, is *seen through*, and *confirmed* if it is about as far. The *support* of a voxel is the
number of points in the 27 cells around it, of twice its side; voxels of other sides do not count.

Four things contradict a voxel. Views *see past* it; the photographs that see it do not *agree* on
its colour, although no ray ends there; they show *another colour* than the cloud; or it lies
*alone*: its support is below ``ALONE`` of the median. Ghosts also hide what is behind them, so
where many voxels go, the others are judged once more without them.
Promise: depends neither on the order of the points nor on the threads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8, UInt16

from splatseed.errors import PointCloudError
from splatseed.photos._kernels import project_point
from splatseed.photos.projection import cells_from_world
from splatseed.photos.view import View
from splatseed.photos.zbuffer import cell_counts
from splatseed.progress import Progress
from splatseed.runtime.hashing import FREE, scramble, slot_of
from splatseed.runtime.jit import inline, kernel, parallel_range
from splatseed.seeding.clouds.voxels import Voxels
from splatseed.seeding.coverage import depths_of_views


def find_support(
    xyz: Float32[np.ndarray, "N 3"], side: Float32[np.ndarray, " N"], count: Int32[np.ndarray, " N"]
) -> Int64[np.ndarray, " N"]:
    """The support of each voxel; sides are powers of two."""
    slots = 1 << int(2 * max(len(xyz), 1)).bit_length()
    keys, sums = np.zeros(slots, np.uint64), np.zeros(slots, np.int64)
    _count(xyz, side, count, keys, sums)
    support = np.empty(len(xyz), np.int64)
    _sum_up(xyz, side, keys, sums, support)
    return support


@inline
def _count(xyz, side, count, keys, sums):  # type: ignore[no-untyped-def]  # Numba's types
    for i in range(len(xyz)):
        key = _key(xyz[i], side[i], 0, 0, 0)
        slot = slot_of(key, keys)
        keys[slot] = key
        sums[slot] += count[i]


@kernel
def _sum_up(xyz, side, keys, sums, support):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(len(xyz)):
        total = np.int64(0)
        for a in range(-1, 2):
            for b in range(-1, 2):
                for c in range(-1, 2):
                    total += sums[slot_of(_key(xyz[i], side[i], a, b, c), keys)]
        support[i] = total


@inline
def _key(point, side, a, b, c):  # type: ignore[no-untyped-def]  # Numba's types
    """A 64-bit key for the cell at an offset from a point's."""
    per_cell = 0.5 / np.float64(side)
    key = scramble(np.uint64(np.int64(np.log2(np.float64(side))) + 4096))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[0] * per_cell)) + a))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[1] * per_cell)) + b))
    key = scramble(key ^ np.uint64(np.int64(np.floor(point[2] * per_cell)) + c))
    return max(key, FREE + np.uint64(1))


CELLS = (4, 8, 16, 32)  # sides of cells to choose from, in pixels
FILLED = 3
BEHIND = 0.03
"""How far behind a surface a point still counts as on it, as a share of the depth, at cells of 4
pixels; surfaces slant within a cell."""
CLOSEST = 6
ALIKE = 32
RAY_CELL = 4  # side in pixels of the cells in which rays are free
NEARER_BY = 0.1  # a point is clearly nearer by this share of the depth
FITS = 0.03  # share of the depth within which a scene's own point lies on a cloud's surface
BLOCK = 1 << 20
NO_VIEW = np.float32(0.0)

Surface = Float32[np.ndarray, "rows cols"]


def free_rays(
    views: Sequence[View],
    seen: Sequence[Float64[np.ndarray, "M 3"]],
    known: Sequence[Surface] | None = None,
) -> tuple[Surface, ...]:
    """How far rays are known to be free: in each view, the least depth per cell; infinite if none.

    By the points that each sees for certain, and by stereo's maps, whose cells they have.
    """
    nearest = []
    for v, (view, xyz) in enumerate(zip(views, seen, strict=True)):
        shape = -(-view.height // RAY_CELL), -(-view.width // RAY_CELL)
        depths = np.array(np.full(shape, np.inf) if known is None else known[v], np.float32)
        rows, cols, depth = _cells(view, xyz, depths.shape)
        np.minimum.at(depths, (rows, cols), depth.astype(np.float32))
        nearest.append(depths)
    return tuple(nearest)


class Evidence(NamedTuple):
    """The evidence for and against N points."""

    seen: UInt16[np.ndarray, " N"]  # in how many views each is visible
    rgb: UInt8[np.ndarray, "N 3"]  # robust mean of its samples; mid grey without any
    agreement: Float32[np.ndarray, " N"]  # of its samples, 0 to 1; NaN for fewer than two
    through: UInt16[np.ndarray, " N"]  # how many views see through it
    confirmed: UInt16[np.ndarray, " N"]  # how many views confirm it

    @property
    def seen_past(self) -> Bool[np.ndarray, " N"]:
        """Where rays are free: enough views see through a point, and more than confirm it."""
        return np.asarray((self.through >= THROUGH) & (self.through > self.confirmed))

    def select(self, which: Bool[np.ndarray, " N"]) -> Evidence:
        """That on some of the points."""
        return Evidence(*(values[which] for values in self))


def find_surfaces(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], progress: Progress
) -> tuple[tuple[Surface, ...], int]:
    """The surface of each view, and the side of its cells in pixels."""
    cell = _choose_cell(views, xyz)
    return tuple(depths_of_views(views, xyz, cell, progress, "find surfaces")), cell


def _choose_cell(views: Sequence[View], xyz: Float32[np.ndarray, "N 3"]) -> int:
    """The smallest side at which a cell that holds points typically holds enough."""
    some = views[:: -(-len(views) // 8)]
    for cell in CELLS[:-1]:
        counts = [
            count[count > 0] for view in some if len(count := cell_counts(view.camera, xyz, cell))
        ]
        filled = np.concatenate(counts)
        if len(filled) and np.median(filled) >= FILLED:
            return cell
    return CELLS[-1]


def find_evidence(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    surfaces: Sequence[Surface],
    cell: int,
    rays: Sequence[Surface] | None,
    progress: Progress,
) -> Evidence:
    """Hold points against photographs; views without pixels give no colours."""
    num = len(xyz)
    evidence = Evidence(
        np.zeros(num, np.uint16),
        np.full((num, 3), 128, np.uint8),
        np.full(num, np.nan, np.float32),
        np.zeros(num, np.uint16),
        np.zeros(num, np.uint16),
    )
    behind = BEHIND * cell / CELLS[0]
    steps = max(len(range(0, num, BLOCK)) * len(views), 1)
    for b, start in enumerate(range(0, num, BLOCK)):
        part = slice(start, start + BLOCK)
        block = xyz[part]
        closeness = np.zeros((len(block), CLOSEST), np.float32)
        samples = np.zeros((len(block), CLOSEST, 3), np.uint8)
        every = np.ones((1, 1), np.bool_)
        for v, view in enumerate(views):
            free = np.empty((0, 0), np.float32) if rays is None else rays[v]
            _observe(
                block, cells_from_world(view.camera, 1), np.sqrt(abs(view.K[0, 0] * view.K[1, 1])),
                view.width, view.height, surfaces[v], behind, free, view.photograph,
                every if view.mask is None else view.mask, closeness, samples,
                evidence.seen[part], evidence.through[part], evidence.confirmed[part],
            )  # fmt: skip
            progress("look at photographs", (b * len(views) + v + 1) / steps)
        _summarise(closeness, samples, evidence.rgb[part], evidence.agreement[part])
    return evidence


def surface_agreement(
    views: Sequence[View], surfaces: Sequence[Surface], seen: Sequence[Float64[np.ndarray, "M 3"]]
) -> tuple[float, int]:
    """Of a scene's points seen where a cloud has a surface: the share that fits, and the number."""
    close = total = 0
    for view, surface, xyz in zip(views, surfaces, seen, strict=True):
        rows, cols, depth = _cells(view, xyz, surface.shape)
        there = surface[rows, cols]
        known = np.isfinite(there)
        total += int(np.count_nonzero(known))
        close += int(np.count_nonzero(np.abs(depth[known] / there[known] - 1.0) <= FITS))
    return (close / total if total else 0.0), total


def _cells(
    view: View, xyz: Float64[np.ndarray, "M 3"], shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and depths of the points that fall into a view's grid of cells."""
    cam = xyz @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    cam = cam[cam[:, 2] > 0]
    uv = (cam @ view.K.T)[:, :2] / cam[:, 2:]
    inside = ((uv >= 0) & (uv < [view.width, view.height])).all(axis=1)
    cols, rows = (uv[inside] * [shape[1] / view.width, shape[0] / view.height]).astype(np.int64).T
    return rows, cols, cam[inside, 2]


@kernel
def _observe(  # type: ignore[no-untyped-def]  # Numba's types
    xyz, matrix, focal, width, height, surface, behind, free, photograph, mask, closeness, samples,
    seen, through, confirmed,
):  # fmt: skip
    """Add what one view sees of the points."""
    for k in parallel_range(len(xyz)):
        column, row, depth = project_point(xyz[k], matrix)
        if not (depth > 0.0 and 0.0 <= column < width and 0.0 <= row < height):
            continue
        i, j = int(row), int(column)
        if mask.size > 1 and not mask[i, j]:
            continue
        if free.size > 0:
            end = free[int(row * free.shape[0] / height), int(column * free.shape[1] / width)]
            if depth < end * (1.0 - NEARER_BY):
                if end < np.inf:
                    through[k] += 1
            elif depth <= end * (1.0 + NEARER_BY):
                confirmed[k] += 1
        at = surface[int(row * surface.shape[0] / height), int(column * surface.shape[1] / width)]
        if at < np.inf and depth <= at * (1.0 + behind):
            seen[k] += 1
            if photograph.size > 0:
                _insert(np.float32(focal / depth), photograph[i, j], closeness[k], samples[k])


@inline
def _insert(close, pixel, closeness, samples):  # type: ignore[no-untyped-def]  # Numba's types
    """Keep a pixel if its view is among the closest; among equals the earlier stays."""
    k = len(closeness) - 1
    if closeness[k] >= close:
        return
    while k > 0 and closeness[k - 1] < close:
        closeness[k], samples[k] = closeness[k - 1], samples[k - 1]
        k -= 1
    closeness[k], samples[k] = close, pixel


@kernel
def _summarise(closeness, samples, rgb, agreement):  # type: ignore[no-untyped-def]  # Numba's types
    """Robust means of samples, and the share of them that agrees."""
    for k in parallel_range(len(closeness)):
        num = 0
        while num < closeness.shape[1] and closeness[k, num] > NO_VIEW:
            num += 1
        if num == 0:
            continue
        middle = np.empty(3, np.int64)
        for channel in range(3):
            ordered = np.sort(samples[k, :num, channel])
            middle[channel] = ordered[(num - 1) // 2]
        alike, total = 0, np.zeros(3, np.int64)
        for s in range(num):
            if _is_alike(samples[k, s], middle):
                alike += 1
                for channel in range(3):
                    total[channel] += samples[k, s, channel]
        for channel in range(3):
            if alike > 0:
                rgb[k, channel] = (2 * total[channel] + alike) // (2 * alike)
            else:
                rgb[k, channel] = middle[channel]
        if num > 1:
            agreement[k] = np.float32(alike) / np.float32(num)


@inline
def _is_alike(sample, middle):  # type: ignore[no-untyped-def]  # Numba's types
    alike = True
    for channel in range(3):
        alike &= abs(np.int64(sample[channel]) - middle[channel]) <= ALIKE
    return alike


AGREES = 0.5
"""Least agreement of the photographs on a voxel's colour, where at least ``ASKED`` see it."""
ASKED = 4
THROUGH = 2  # views that see past a voxel from which on it is not there, if fewer confirm it
CONFIRMED = 2
"""Views that confirm a voxel from which on the photographs need not agree on its colour."""
OTHER = 64
"""Grey levels by which colours differ clearly, beside ``LIKELY`` times what they differ by
anyway."""
LIKELY = 4.0
ALONE = 0.05
AGAIN = 0.002  # share of voxels that go from which on the others are judged once more


class Judged(NamedTuple):
    """The verdict on a cloud's voxels."""

    kept: Int64[np.ndarray, " K"]  # those that stay, rising
    evidence: Evidence  # on these
    fit: float  # of the scene's points seen where the cloud has a surface, the share at its depth
    asked: int  # the number of these points
    hidden: int  # voxels that no photograph sees
    reasons: dict[str, int]  # how many others went, by reason


def judge(
    views: Sequence[View],
    seen: Sequence[Float64[np.ndarray, "M 3"]],
    voxels: Voxels,
    colors: UInt8[np.ndarray, "N 3"] | None,
    progress: Progress,
    *,
    clean: bool = True,
    rays: Sequence[Surface] | None = None,
) -> Judged:
    """Judge the voxels of a cloud.

    ``seen`` are the scene's own points that each view sees, ``colors`` the cloud's own; without
    ``clean`` only hidden voxels go.
    """
    reasons: Counter[str] = Counter()
    active = np.arange(len(voxels))
    if clean:
        support = find_support(voxels.xyz, voxels.side, voxels.count)
        lone = support < ALONE * np.median(support)
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


def _against(
    evidence: Evidence, colors: UInt8[np.ndarray, "N 3"] | None
) -> tuple[Bool[np.ndarray, " N"], dict[str, int]]:
    """Which voxels are contradicted, and how many by reason; the first counts."""
    past = evidence.seen_past
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
        "are seen through": past,
        "differ in colour from the photographs": other,
        "look different in every photograph": torn,
    }
    for reason, which in named.items():
        counts[reason] = int(np.count_nonzero(which & ~against))
        against |= which
    return against, counts
