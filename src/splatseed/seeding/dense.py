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

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from splatseed.depth.stereo.closer import compare_closer
from splatseed.depth.stereo.detail import expected_spacing, fuse_at_most
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.methods import source_code
from splatseed.methods.contract import NewPoints, Traits
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import at_file_size, factor_for_size
from splatseed.photos.view import View
from splatseed.photos.visibility import find_visibility, points_in_image
from splatseed.progress import Note, Progress, num_threads
from splatseed.runtime.compilation import watched
from splatseed.runtime.memory import PROCESS, format_bytes, free_memory, resident_bytes
from splatseed.scene import Image, Scene
from splatseed.seeding.photo_methods import Stereo, photographed, stereo_points

if TYPE_CHECKING:
    from splatseed.depth.stereo.detail import Placed
    from splatseed.depth.stereo.maps import StereoResult

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
class Plan:
    """How photographs are compared again."""

    factor: int  # photographs are reduced by this
    grid: int  # pixels of the reduced photographs between depths
    split: int  # places for seeds along a row and a column of a depth's pixel
    num_depths: int  # of all views
    memory: int  # of the process, bytes; an upper bound
    within: bool  # whether free memory holds that


@dataclass(frozen=True)
class WithinBudget:
    """A method that compares photographs, within a budget.

    Args:
        method: ``auto`` or ``stereo``.
        limit: Points in all.
        announce: Called with a sentence on time and memory before the second comparison.
    """

    method: Stereo
    limit: int
    announce: Note

    @property
    def name(self) -> str:
        """The name of the method."""
        return self.method.name

    @property
    def traits(self) -> Traits:
        """The traits of the method."""
        return self.method.traits

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make the points of a scene; ``num_new`` is ignored."""
        watch = _Stopwatch(progress)
        with watch.running():
            new, stereo = self.method.run(scene, rng, watch)
        room = self.limit - len(scene.points.originals)
        from_stereo = np.asarray(new.source) == source_code("stereo")
        # Cover's guesses stay as sparse as they are: more of them would confirm nothing.
        num = room - int(np.count_nonzero(~from_stereo))
        if len(new.xyz) >= room:
            return new
        spacing, finest = expected_spacing(stereo, num, self.method.spacing)
        if not finest:  # nothing is confirmed that could be sampled more closely
            return new._replace(notes=(*new.notes, *self._shortage(scene, new)))
        images = at_file_size(
            scene.replace(images=photographed(scene, self.method.test_every))
        ).images
        first = factor_for_size(images, self.method.max_size)
        plans = plan_comparisons(images, first, self.method.grid, first * finest, self.limit)
        plan = next((each for each in plans if each.within), plans[-1])
        dense = stereo
        if (plan.factor, plan.grid) != (first, self.method.grid):
            self.announce(_announcement(self.limit, images, plan, stereo, watch.seconds))
            views = _read_again(scene, images, plan.factor, stereo.views, progress)
            dense = compare_closer(stereo, views, plan.grid, int(rng.integers(1 << 32)), progress)
        scale = first / plan.factor
        known = _originals_in_views(scene, images, dense.views)
        largest = self.method.spacing * scale
        seeds = fuse_at_most(
            dense, num, largest, known, spacing * scale, progress, plan.split
        )  # fmt: skip
        points = self.method.fill(
            scene, stereo_points(seeds, new.notes, stereo), stereo.views, rng, progress
        )
        points = _drop_guesses(points, room)
        need = 0 if plan is plans[0] else plans[0].memory
        return points._replace(notes=(*new.notes, *self._shortage(scene, points, need)))

    def _shortage(self, scene: Scene, points: NewPoints, need: int = 0) -> tuple[str, ...]:
        """Say why there are fewer points than the budget allows, if so.

        ``need`` is the memory that comparing more pixels would take; 0 if that is not the reason.
        """
        num_known = len(scene.points.originals)
        if num_known + len(points.xyz) >= DENSE.nearly * self.limit:
            return ()
        from_stereo = np.asarray(points.source) == source_code("stereo")
        confirmed = num_known + int(np.count_nonzero(from_stereo))
        others = len(points.xyz) - int(np.count_nonzero(from_stereo))
        note = f"Photographs confirm {confirmed:,} of the {self.limit:,} points of the budget"
        note += f"; {others:,} more fill gaps." if others else "."
        if need:
            amount = format_bytes(need)
            note += f" Comparing more of their pixels takes {amount} of memory, which is not free."
        return (note,)


def plan_comparisons(
    images: Sequence[Image], first: int, grid: int, finest: float, num: int
) -> list[Plan]:
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


def _plan(images: Sequence[Image], factor: int, grid: int, split: int, num: int) -> Plan:
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
    return Plan(factor, grid, split, sum(depths), (resident_bytes() or PROCESS) + more, within)


def _announcement(
    limit: int,
    images: Sequence[Image],
    plan: Plan,
    stereo: StereoResult,
    seconds: Mapping[str, float],
) -> str:
    """Say what is compared, and the time and memory that takes by the first comparison."""
    ratio = plan.num_depths / max(sum(cost.size for cost in stereo.costs), 1)
    spent = {stage: seconds.get(stage, 0.0) for stage in STAGES}
    expected = ratio * (
        DENSE.matching * spent["compare photographs"]
        + spent["compare depths"]
        + DENSE.fusions * plan.split**2 * spent["fuse depths"]
    )
    expected += spent["read images"] + spent["cover"]
    sides = max((im.camera.width // plan.factor, im.camera.height // plan.factor) for im in images)
    return (
        f"Up to {limit:,} points: {len(images)} photographs are compared again at "
        f"{sides[0]} x {sides[1]} pixels, with a depth every {plan.grid}: about "
        f"{_duration(expected)} and {format_bytes(plan.memory)} of memory."
    )


def _duration(seconds: float) -> str:
    return f"{max(round(seconds), 1)} s" if seconds < 90 else f"{round(seconds / 60)} minutes"


def _read_again(
    scene: Scene, images: Sequence[Image], factor: int, before: Sequence[View], progress: Progress
) -> tuple[View, ...]:
    """Read the photographs at another size."""
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


def _drop_guesses(points: NewPoints, room: int) -> NewPoints:
    """Drop cover's least confident seeds beyond the number of points that there is room for."""
    surplus = len(points.xyz) - room
    guesses = np.flatnonzero(np.asarray(points.source) == source_code("cover"))
    if surplus <= 0 or not len(guesses):
        return points
    kept = np.ones(len(points.xyz), np.bool_)
    confidence = np.asarray(points.confidence)[guesses]
    kept[guesses[np.argsort(confidence, kind="stable")[:surplus]]] = False
    arrays = {
        name: getattr(points, name)[kept]
        for name in ("xyz", "rgb", "normals", "sizes", "confidence", "source")
    }
    return points._replace(**arrays)


class _Stopwatch:
    """A ``Progress`` that adds up the wall time of stages, without compilation."""

    def __init__(self, progress: Progress) -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress
        self._last = time.perf_counter()
        self._nested, self._begun, self._compiled = 0, 0.0, 0.0

    def __call__(self, stage: str, fraction: float) -> None:
        """Add the time since the last call to this stage."""
        now = time.perf_counter()
        past = max(now - self._last - self._compiled, 0.0)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + past
        self._last, self._compiled = now, 0.0
        self._progress(stage, fraction)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Leave out the time of compilation while the block runs."""
        self._last = time.perf_counter()
        with watched(self._compilation):
            yield

    def _compilation(self, begins: bool) -> None:
        self._nested += 1 if begins else -1
        if begins and self._nested == 1:
            self._begun = time.perf_counter()
        elif not begins and self._nested == 0:
            self._compiled += time.perf_counter() - self._begun
