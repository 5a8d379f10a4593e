"""Dense seeds: as many as a budget allows, where the photographs confirm them.

``stereo`` and ``auto`` run as without a budget first. Where that gives fewer points than allowed,
the photographs are compared again, larger and on a finer grid, starting from the depths found, and
seeds are chosen in proportion to detail (``depth.stereo.detail``). Size and grid follow from the
spacing that the number needs; time follows from the first comparison on this machine, and memory is
kept within what is free.

Notation: lengths are in pixels of the photographs' files; photographs are reduced by a whole
*factor*, and depths are *grid* pixels of the reduced photographs apart.
Promise: never more points than allowed; a budget that the first comparison fills gives the same
points as thinning does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from splatseed.depth.stereo.detail import expected_spacing, fuse_at_most
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.pipeline import compare_closer
from splatseed.findings import Finding
from splatseed.io.regions import Region
from splatseed.methods import source_code
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.view import View
from splatseed.photos.visibility import find_visibility, points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, Progress, num_threads
from splatseed.runtime.memory import PROCESS, format_bytes, free_memory, resident_bytes
from splatseed.scene import Image, Scene
from splatseed.text import format_duration

if TYPE_CHECKING:
    from splatseed.depth.stereo.detail import Placed
    from splatseed.depth.stereo.maps import StereoResult

STEREO = source_code("stereo")
SECOND_COMPARISON = "second-comparison"
"""Kind of the finding that announces another comparison, before it starts."""
STAGES = ("read images", "compare photographs", "compare depths", "fuse depths", "cover")
"""Stages of the first comparison from which the time of the second is estimated."""


@dataclass(frozen=True)
class _DenseSettings:
    """Sizes of the second comparison, and what it costs relative to the first."""

    max_size: int = 1600  # longer side of photographs, pixels
    grids: tuple[int, ...] = (2, 4)  # pixels between depths
    split: int = 2  # a pixel of a map has seeds up to this many times as close as its grid
    matching: float = 0.25  # time per depth: one sweep instead of four, on larger photographs
    fusions: float = 1.5  # time per place: several spacings, but each confidence only once
    depth_bytes: int = 17  # a plane, its cost and agreement
    order_bytes: int = 4 + 1 + 4  # per depth: order, level, one contrast of all views at a time
    cell_bytes: int = 8  # per place: cells of all levels
    guess_bytes: int = 4 * 3 * 4  # per depth of a view that is being matched
    seed_bytes: int = 240  # per seed while it is made and written
    usable: float = 0.85  # share of the free memory
    nearly: float = 0.95  # share of a budget from which on it counts as full


DENSE = _DenseSettings()


@dataclass(frozen=True)
class ComparisonPlan:
    """How photographs are compared again."""

    factor: int  # photographs are reduced by this
    grid: int  # pixels of the reduced photographs between depths
    split: int  # places for seeds along a row and a column of a depth's pixel
    num_depths: int  # of all views
    memory: int  # of the process, bytes; an upper bound
    within: bool  # whether free memory holds that


@dataclass(frozen=True, eq=False)
class Comparison:
    """The first comparison of photographs."""

    images: tuple[Image, ...]
    stereo: StereoResult
    max_size: int  # maximum side of the photographs, in pixels
    spacing: float  # pixels between its seeds
    seconds: Mapping[str, float]  # time of its stages


def fill_budget(
    scene: Scene,
    first: Comparison,
    points: PointCloud,
    budget: int,
    refill: Callable[[PointCloud], PointCloud],
    rng: np.random.Generator,
    progress: Progress,
    note: Note,
    region: Region | None = None,
) -> PointCloud:
    """Replace the new points of a first comparison by as many as a budget allows.

    Args:
        scene: The scene.
        first: The first comparison.
        points: Its new points, of stereo and others.
        budget: Points in all.
        refill: Adds the points of others to denser seeds of stereo.
        rng: Draws the seed of the second comparison.
        progress: Called with the stage and the fraction done.
        note: Called with the time and memory before the second comparison, and with a shortage.
        region: Where the new points count, and are to be.

    Returns:
        The new points: ``points`` themselves if they fill the budget, or nothing is confirmed that
        could be sampled more closely. With a region, those that were measured outside of it follow.
    """
    stereo, grid, beyond = first.stereo, first.stereo.settings.grid, PointCloud.empty()
    if region is not None:
        stereo = stereo.within(region)
        inside = region(points.xyz)
        beyond = points.select(~inside & (points.source != source_code("cover")))
        points = points.select(inside)
    num_known = len(scene.points.originals)
    room = budget - num_known
    # Cover's guesses stay as sparse as they are: more of them would confirm nothing.
    num = room - (len(points) - _count_stereo(points))
    if len(points) >= room:
        return PointCloud.concatenate(points, beyond)
    spacing, finest = expected_spacing(stereo, num, first.spacing)
    need = 0
    if finest:
        images = first.images
        factor = factor_for_size(images, first.max_size)
        plans = plan_comparisons(images, factor, grid, factor * finest, budget)
        plan = next((each for each in plans if each.within), plans[-1])
        dense = stereo
        if (plan.factor, plan.grid) != (factor, grid):
            note(_announcement(budget, images, plan, stereo, first.seconds))
            views = _read_again(scene, images, plan.factor, stereo.views, progress)
            dense = compare_closer(stereo, views, plan.grid, int(rng.integers(1 << 32)), progress)
            dense = dense if region is None else dense.within(region)
        scale = factor / plan.factor
        known = _originals_in_views(scene, images, dense.views)
        seeds = fuse_at_most(
            dense, num, first.spacing * scale, known, spacing * scale, progress, plan.split
        )
        seeds = seeds.with_source(STEREO)
        if region is None:
            filled = refill(seeds)
        else:  # cover guesses wrong depths where it does not know what lies beyond the region
            filled = refill(PointCloud.concatenate(beyond, seeds))
            filled = filled.select(region(filled.xyz))
        points = _drop_guesses(filled, room)
        need = 0 if plan is plans[0] else plans[0].memory
    if num_known + len(points) < DENSE.nearly * budget:
        note(_shortage(scene, points, budget, need))
    return points if region is None else PointCloud.concatenate(points, beyond)


def _count_stereo(points: PointCloud) -> int:
    return int(np.count_nonzero(points.source == STEREO))


def _shortage(scene: Scene, points: PointCloud, budget: int, need: int) -> Finding:
    """Explain why there are fewer points than a budget allows.

    ``need`` is the memory that comparing more pixels would take; 0 if that is not the reason.
    """
    confirmed = len(scene.points.originals) + _count_stereo(points)
    others = len(points) - _count_stereo(points)
    text = f"Photographs confirm {confirmed:,} of the {budget:,} points of the budget"
    text += f"; {others:,} more fill gaps." if others else "."
    if need:
        amount = format_bytes(need)
        text += f" Comparing more of their pixels takes {amount} of memory, which is not free."
    return Finding("budget-not-filled", text)


def plan_comparisons(
    images: Sequence[Image], first: int, grid: int, finest: float, num: int
) -> list[ComparisonPlan]:
    """Plan the second comparison: what the spacing needs, then what needs less and less memory.

    Args:
        images: The images, in pixels of their files.
        first: Factor of the first comparison.
        grid: Its grid, which the last plan has.
        finest: Side of the smallest cells, pixels of the file.
        num: Points to make.
    """
    least = min(first, factor_for_size(images, DENSE.max_size))
    factor = min(max(int(finest / max(DENSE.grids)), least), first)
    pairs = [(factor, each) for each in DENSE.grids]
    pairs += [(each, max(DENSE.grids)) for each in range(factor + 1, first + 1)]
    pairs = [(each, step) for each, step in pairs if each * step < first * grid]
    pairs.append((first, grid))
    # The coarsest grid that resolves the smallest cells, then all that need less memory.
    fine = [i for i, (each, step) in enumerate(pairs) if each * step / DENSE.split <= finest]
    start = max((i for i in fine if pairs[i][0] == factor), default=0)
    plans = []
    for each, step in pairs[start:]:
        split = DENSE.split if each * step > finest and step % DENSE.split == 0 else 1
        plans.append(_plan(images, each, step, split, num))
    return plans


def _plan(images: Sequence[Image], factor: int, grid: int, split: int, num: int) -> ComparisonPlan:
    """Estimate the memory of a comparison."""
    sizes = [(im.camera.width // factor, im.camera.height // factor) for im in images]
    pixels = [width * height for width, height in sizes]
    depths = [(width // grid) * (height // grid) for width, height in sizes]
    threads = min(num_threads(), len(images))
    sources = 1 + min(StereoSettings().num_sources, len(images) - 1)
    # Colours and grey; each thread's photographs with 4 bytes per pixel and candidate planes.
    matching = 4 * sum(pixels) + DENSE.depth_bytes * sum(depths)
    matching += threads * (4 * sources * max(pixels) + DENSE.guess_bytes * max(depths))
    places = split**2 * sum(depths)
    fusion = 3 * sum(pixels) + (DENSE.depth_bytes + DENSE.order_bytes) * sum(depths)
    # Two other views confirm a seed, so that there are three places per seed at least.
    fusion += DENSE.cell_bytes * places + DENSE.seed_bytes * min(num, places // 3)
    more = max(matching, fusion)
    free = free_memory()
    within = free is None or more <= DENSE.usable * free
    return ComparisonPlan(
        factor, grid, split, sum(depths), (resident_bytes() or PROCESS) + more, within
    )


def _announcement(
    limit: int,
    images: Sequence[Image],
    plan: ComparisonPlan,
    stereo: StereoResult,
    seconds: Mapping[str, float],
) -> Finding:
    """Announce what is compared, and the time and memory that takes by the first comparison."""
    ratio = plan.num_depths / max(sum(cost.size for cost in stereo.costs), 1)
    spent = {stage: seconds.get(stage, 0.0) for stage in STAGES}
    expected = ratio * (
        DENSE.matching * spent["compare photographs"]
        + spent["compare depths"]
        + DENSE.fusions * plan.split**2 * spent["fuse depths"]
    )
    expected += spent["read images"] + spent["cover"]
    sides = max((im.camera.width // plan.factor, im.camera.height // plan.factor) for im in images)
    text = (
        f"Up to {limit:,} points: {len(images)} photographs are compared again at "
        f"{sides[0]} x {sides[1]} pixels, with a depth every {plan.grid}: about "
        f"{format_duration(expected)} and {format_bytes(plan.memory)} of memory."
    )
    return Finding(SECOND_COMPARISON, text, "info")


def _read_again(
    scene: Scene, images: Sequence[Image], factor: int, before: Sequence[View], progress: Progress
) -> tuple[View, ...]:
    names = {view.name for view in before}
    used = [image for image in images if image.name in names]

    def again(stage: str, fraction: float) -> None:
        progress(f"{stage} again", fraction)

    return load_views(scene, used, data_factor=factor, undistort=True, progress=again)


def _originals_in_views(
    scene: Scene, images: Sequence[Image], views: Sequence[View]
) -> list[Placed]:
    """Pixels and depths of the originals that each view sees."""
    visibility = find_visibility(scene)
    placed = []
    for image, view in zip(images, views, strict=True):
        seen = points_in_image(view.camera, visibility.of(image))
        placed.append((seen.uv, seen.depth))
    return placed


def _drop_guesses(points: PointCloud, room: int) -> PointCloud:
    """Drop cover's least confident seeds beyond the number of points that there is room for."""
    surplus = len(points) - room
    guesses = np.flatnonzero(points.source == source_code("cover"))
    if surplus <= 0 or not len(guesses):
        return points
    kept = np.ones(len(points), np.bool_)
    confidence = np.asarray(points.confidence)[guesses]
    kept[guesses[np.argsort(confidence, kind="stable")[:surplus]]] = False
    return points.select(kept)
