"""Photo-consistency: which voxels of a cloud the photographs see, and which they contradict.

Notation: a view's *surface* is the depth of its cells (``photos.zbuffer``), of a side at which a
typical cell holds ``min_points_per_cell`` points, so that walls have no holes. A view *sees* points
in front of its surface, and up to ``behind`` of the depth behind it. The *samples* of a point are
its pixels in the ``closest`` views that see it; their *agreement* is the fraction within
``COLOR_TOLERANCE`` grey levels of their median, per channel. A tracked point of
Structure-from-Motion, or a depth of stereo, proves that the ray to it is free space: a cloud point
in the same cell of the same view *violates* it if it is clearly nearer, and is *confirmed* if it is
about as far. The *support* of a voxel is the number of points in the 27 cells around it, of twice
its side; voxels of other sides do not count.

A voxel is dropped if it violates free space; if the photographs that see it do not agree on its
colour, although no ray ends there (*inconsistent*); if they show another colour than the cloud; or
if it is isolated: its support is below ``min_support`` of the median. Outliers also hide what is
behind them, so where many voxels are dropped, the others are checked again without them.
Promise: results depend neither on the order of the points nor on the number of threads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8, UInt16

from splatseed.errors import PointCloudError
from splatseed.frozen import read_only_view
from splatseed.photos.view import View
from splatseed.photos.visibility import points_in_image
from splatseed.photos.zbuffer import cell_counts
from splatseed.progress import Progress
from splatseed.sampling import strided
from splatseed.seeding.clouds._kernels import count_by_cell, observe, sum_around, summarise
from splatseed.seeding.clouds.voxels import Voxels
from splatseed.seeding.cover import cell_depths_of_views

SurfaceDepths = Float32[np.ndarray, "rows cols"]


@dataclass(frozen=True)
class ConsistencySettings:
    """How points are compared with photographs, and what contradicts them."""

    cells: tuple[int, ...] = (4, 8, 16, 32)
    """Sides of a surface's cells to choose from, in pixels, rising."""
    min_points_per_cell: int = 3
    behind: float = 0.03
    """Fraction of the depth by which a point may lie behind a surface, at the smallest cells;
    surfaces slant within a cell, so it grows with the cell."""
    closest: int = 6
    """Views whose pixels are sampled."""
    ray_cell: int = 4
    """Side in pixels of the cells in which rays are free."""
    fit_tolerance: float = 0.03
    """Fraction of the depth within which a scene's own point lies on a cloud's surface."""
    min_agreement: float = 0.5
    """Minimum agreement on a voxel's colour, where ``min_views`` see it."""
    min_views: int = 4
    min_violations: int = 2
    """Views that see through a voxel from which on it is dropped, if fewer confirm it."""
    min_confirmations: int = 2
    """Views that confirm a voxel from which on its colour need not agree: what shines looks
    different from all sides."""
    color_difference: int = 64
    """Grey levels by which colours of cloud and photographs may differ, beyond ..."""
    color_factor: float = 4.0
    """... this factor of the median difference."""
    min_filling: float = 0.05
    """Fraction of the voxels that have one colour, from which on it may stand for none ..."""
    filling_difference: int = 16
    """... if the photographs' differ by more grey levels, beyond ..."""
    filling_factor: float = 2.0
    """... this factor of the median difference of the others."""
    min_support: float = 0.05
    repeat_above: float = 0.002
    """Fraction of dropped voxels above which the others are checked again."""


CONSISTENCY = ConsistencySettings()
BLOCK = 1 << 20  # points compared at a time


def find_support(
    xyz: Float32[np.ndarray, "N 3"], side: Float32[np.ndarray, " N"], count: Int32[np.ndarray, " N"]
) -> Int64[np.ndarray, " N"]:
    """Return the support of each voxel; sides are powers of two."""
    slots = 1 << int(2 * max(len(xyz), 1)).bit_length()
    keys, sums = np.zeros(slots, np.uint64), np.zeros(slots, np.int64)
    count_by_cell(xyz, side, count, keys, sums)
    support = np.empty(len(xyz), np.int64)
    sum_around(xyz, side, keys, sums, support)
    return support


def free_space(
    views: Sequence[View],
    visible: Sequence[Float64[np.ndarray, "M 3"]],
    stereo_depths: Sequence[SurfaceDepths] | None = None,
) -> tuple[SurfaceDepths, ...]:
    """Return the depth up to which each view's rays are free, per cell; infinite if unknown.

    It is the smallest depth of the points that a view certainly sees, ``visible``, and of the maps
    of stereo, whose cells it has.
    """
    side = CONSISTENCY.ray_cell
    free = []
    for v, (view, xyz) in enumerate(zip(views, visible, strict=True)):
        shape = -(-view.height // side), -(-view.width // side)
        unknown = np.full(shape, np.inf)
        depths = np.array(unknown if stereo_depths is None else stereo_depths[v], np.float32)
        points = points_in_image(view.camera, xyz)
        cells = points.cells(view.camera, depths.shape)
        np.minimum.at(depths, cells, points.depth.astype(np.float32))
        free.append(depths)
    return tuple(free)


class Evidence(NamedTuple):
    """What the photographs show of N points."""

    num_views: UInt16[np.ndarray, " N"]  # that see each
    rgb: UInt8[np.ndarray, "N 3"]  # robust mean of its samples; mid grey without any
    agreement: Float32[np.ndarray, " N"]  # of its samples, 0 to 1; NaN for fewer than two
    violations: UInt16[np.ndarray, " N"]  # views in whose free space it lies
    confirmations: UInt16[np.ndarray, " N"]  # views whose free rays end there

    @property
    def free_space_violation(self) -> Bool[np.ndarray, " N"]:
        """Whether enough views see through a point, and more than confirm it."""
        enough = self.violations >= CONSISTENCY.min_violations
        return np.asarray(enough & (self.violations > self.confirmations))

    def select(self, which: Bool[np.ndarray, " N"]) -> Evidence:
        """Return the evidence on some of the points."""
        return Evidence(*(values[which] for values in self))


def find_surfaces(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], progress: Progress
) -> tuple[tuple[SurfaceDepths, ...], int]:
    """Return the surface of each view, and the side of its cells in pixels."""
    cell = _choose_cell(views, xyz)
    return tuple(cell_depths_of_views(views, xyz, cell, progress, "find surfaces")), cell


def _choose_cell(views: Sequence[View], xyz: Float32[np.ndarray, "N 3"]) -> int:
    """Return the smallest side at which the median non-empty cell holds enough points."""
    sample = strided(views, 8)
    for cell in CONSISTENCY.cells[:-1]:
        counts = np.concatenate([cell_counts(view.camera, xyz, cell) for view in sample])
        counts = counts[counts > 0]
        if len(counts) and np.median(counts) >= CONSISTENCY.min_points_per_cell:
            return cell
    return CONSISTENCY.cells[-1]


def find_evidence(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    surfaces: Sequence[SurfaceDepths],
    cell: int,
    free: Sequence[SurfaceDepths] | None,
    progress: Progress,
) -> Evidence:
    """Compare points with photographs.

    Args:
        views: Those without pixels give no colours.
        xyz: The points.
        surfaces: As of ``find_surfaces``.
        cell: Side of their cells, in pixels.
        free: As of ``free_space``; None if no ray is known to be free.
        progress: Called with the stage and the fraction done.
    """
    num, closest = len(xyz), CONSISTENCY.closest
    evidence = Evidence(
        np.zeros(num, np.uint16),
        np.full((num, 3), 128, np.uint8),
        np.full(num, np.nan, np.float32),
        np.zeros(num, np.uint16),
        np.zeros(num, np.uint16),
    )
    behind = CONSISTENCY.behind * cell / CONSISTENCY.cells[0]
    no_mask, no_rays = np.ones((1, 1), np.bool_), np.empty((0, 0), np.float32)
    steps = max(len(range(0, num, BLOCK)) * len(views), 1)
    for b, start in enumerate(range(0, num, BLOCK)):
        part = slice(start, start + BLOCK)
        block = read_only_view(xyz[part])
        closeness = np.zeros((len(block), closest), np.float32)
        samples = np.zeros((len(block), closest, 3), np.uint8)
        for v, view in enumerate(views):
            observe(
                block, view.camera.pixels_from_world,
                np.sqrt(abs(view.K[0, 0] * view.K[1, 1])), view.width, view.height, surfaces[v],
                behind, no_rays if free is None else free[v], view.photograph,
                no_mask if view.surface is None else view.surface, closeness, samples,
                evidence.num_views[part], evidence.violations[part], evidence.confirmations[part],
            )  # fmt: skip
            progress("compare with photographs", (b * len(views) + v + 1) / steps)
        summarise(closeness, samples, evidence.rgb[part], evidence.agreement[part])
    return evidence


def colors_of_points(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], progress: Progress
) -> UInt8[np.ndarray, "N 3"]:
    """Return the colours of points in the photographs that see them; mid grey where none does."""
    surfaces, cell = find_surfaces(views, xyz, progress)
    return find_evidence(views, xyz, surfaces, cell, None, progress).rgb


def surface_agreement(
    views: Sequence[View],
    surfaces: Sequence[SurfaceDepths],
    visible: Sequence[Float64[np.ndarray, "M 3"]],
) -> tuple[float, int]:
    """Compare a scene's visible points with a cloud's surface.

    Returns the fraction of points at the depth of the surface, and the number of points where there
    is one.
    """
    close = total = 0
    for view, surface, xyz in zip(views, surfaces, visible, strict=True):
        points = points_in_image(view.camera, xyz)
        depth = surface[points.cells(view.camera, surface.shape)]
        known = np.isfinite(depth)
        total += int(np.count_nonzero(known))
        deviation = np.abs(points.depth[known] / depth[known] - 1.0)
        close += int(np.count_nonzero(deviation <= CONSISTENCY.fit_tolerance))
    return (close / total if total else 0.0), total


class ConsistentVoxels(NamedTuple):
    """The voxels of a cloud that photographs see and do not contradict."""

    kept: Int64[np.ndarray, " K"]  # their rows, rising
    evidence: Evidence  # on them
    uncolored: Bool[np.ndarray, " K"]  # whether the cloud has no colour of each
    fit: float  # fraction of the scene's points at the cloud's depth, where it has a surface
    num_compared: int  # the number of these points
    num_hidden: int  # voxels that no photograph sees
    dropped: dict[str, int]  # how many others were dropped, by reason


def consistent_voxels(
    views: Sequence[View],
    visible: Sequence[Float64[np.ndarray, "M 3"]],
    voxels: Voxels,
    colors: UInt8[np.ndarray, "N 3"] | None,
    progress: Progress,
    *,
    clean: bool = True,
    free: Sequence[SurfaceDepths] | None = None,
) -> ConsistentVoxels:
    """Select the voxels that photographs see and do not contradict.

    Args:
        views: The photographs.
        visible: The scene's own points that each view sees.
        voxels: The cloud.
        colors: The cloud's own, if it has any.
        progress: Called with the stage and the fraction done.
        clean: Without it, only hidden voxels are dropped.
        free: As of ``free_space``.
    """
    dropped: Counter[str] = Counter()
    active = np.arange(len(voxels))
    if clean:
        support = find_support(voxels.xyz, voxels.side, voxels.count)
        isolated = support < CONSISTENCY.min_support * np.median(support)
        dropped["are isolated"] = int(np.count_nonzero(isolated))
        active = active[~isolated]
    for last in (False, True):
        xyz = voxels.xyz[active]
        surfaces, cell = find_surfaces(views, xyz, progress)
        evidence = find_evidence(views, xyz, surfaces, cell, free, progress)
        contradicted, uncolored = np.zeros(len(active), bool), np.zeros(len(active), bool)
        own = None if colors is None else colors[active]
        if own is not None:
            uncolored = _uncolored(own, voxels.has_color[active], evidence)
        if clean:
            contradicted, counts = _contradicted(evidence, own, ~uncolored)
            dropped.update(counts)
        if last or np.count_nonzero(contradicted) <= CONSISTENCY.repeat_above * len(active):
            break
        active = active[~contradicted]
    seen = evidence.num_views > 0
    if not seen.any():
        raise PointCloudError(
            "points of the cloud that a photograph sees", found="none", fix="Check its frame."
        )
    fit, num_compared = surface_agreement(views, surfaces, visible)
    kept = seen & ~contradicted
    num_hidden = int(np.count_nonzero(~seen & ~contradicted))
    return ConsistentVoxels(
        active[kept], evidence.select(kept), uncolored[kept], fit, num_compared, num_hidden, dropped
    )


def _uncolored(
    colors: UInt8[np.ndarray, "N 3"], has_color: Bool[np.ndarray, " N"], evidence: Evidence
) -> Bool[np.ndarray, " N"]:
    """Find the voxels of which a cloud has no colour.

    These are black, or have one colour in common that the photographs contradict: some writers fill
    in white or grey where the scanner saw none.
    """
    code = colors.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], np.int32)
    codes, counts = np.unique(code[has_color], return_counts=True)
    uncolored = ~has_color
    for filling in codes[counts >= CONSISTENCY.min_filling * len(colors)]:
        filled = has_color & (code == filling)
        difference, typical = _compare_colors(evidence, colors, has_color & ~filled)
        known = difference[filled & ~np.isnan(difference)]
        limit = CONSISTENCY.filling_difference + CONSISTENCY.filling_factor * typical
        if len(known) and np.median(known) > limit:
            uncolored |= filled
    return uncolored


def _compare_colors(
    evidence: Evidence, colors: UInt8[np.ndarray, "N 3"], known: Bool[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, " N"], float]:
    """Return how far colours are from the photographs', and the median of the ``known`` ones.

    NaN where photographs show nothing; the median is infinite if they do nowhere.
    """
    difference = np.abs(colors.astype(np.int16) - evidence.rgb).max(axis=1).astype(np.float64)
    difference[np.isnan(evidence.agreement)] = np.nan
    typical = difference[known & ~np.isnan(difference)]
    return difference, float(np.median(typical)) if len(typical) else np.inf


def _contradicted(
    evidence: Evidence, colors: UInt8[np.ndarray, "N 3"] | None, colored: Bool[np.ndarray, " N"]
) -> tuple[Bool[np.ndarray, " N"], dict[str, int]]:
    """Find the voxels that photographs contradict, and count them by their first reason.

    ``colored``: those of which the cloud has a colour.
    """
    s = CONSISTENCY
    violation = evidence.free_space_violation
    # NaN compares false.
    inconsistent = (evidence.num_views >= s.min_views) & (evidence.agreement < s.min_agreement)
    inconsistent &= evidence.confirmations < s.min_confirmations
    other_color = np.zeros_like(violation)
    if colors is not None:
        difference, typical = _compare_colors(evidence, colors, colored)
        other_color = colored & (difference > s.color_difference + s.color_factor * typical)
    contradicted = np.zeros_like(violation)
    counts = {}
    reasons = {
        "are seen through": violation,
        "differ in colour from the photographs": other_color,
        "look different in every photograph": inconsistent,
    }
    for reason, which in reasons.items():
        counts[reason] = int(np.count_nonzero(which & ~contradicted))
        contradicted |= which
    return contradicted, counts
