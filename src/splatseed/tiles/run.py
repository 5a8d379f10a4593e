"""A cloud in tiles, from the first row to the last new point: the steps in their order.

Promise: a step that is finished is not done again by the command that goes on after a kill; the
points are those of ``splatseed.upsample.upsample``, byte for byte.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import ParameterError
from splatseed.process.tasks import Tasks
from splatseed.progress import Progress
from splatseed.tiles.assembly import Piece, box_points, new_points, originals
from splatseed.tiles.drawing import draw
from splatseed.tiles.planning import TilePlan
from splatseed.tiles.reading import Rows, read_rows
from splatseed.tiles.repeats import find_repeats, repeated, repeats_known
from splatseed.tiles.sources import Source
from splatseed.tiles.splitting import split
from splatseed.tiles.steps import made_name, place_tile, weigh_tile, weighed_name
from splatseed.tiles.store import TileStore
from splatseed.tiles.work import WorkFolder
from splatseed.upsample import Upsampler, planned_size
from splatseed.upsample.methods.bounding_box import BoundingBox
from splatseed.upsample.nearest import NearestMethod

LAYOUT = 3
"""Changes with the files of the work folder, so that another version's are not gone on with."""


@dataclass(frozen=True)
class Request:
    """What to make.

    Args:
        name: The method's name.
        method: The method.
        ratio: Points in all, as a multiple of the originals.
        num_points: Points in all, instead.
        seed: The seed.
    """

    name: str
    method: Upsampler
    ratio: float | None = None
    num_points: int | None = None
    seed: int = 0

    def job(self, source: Source) -> dict[str, object]:
        """All that determines the result, as JSON has it."""
        parameters: dict[str, Any] = asdict(self.method)  # type: ignore[call-overload]  # a method is a dataclass
        return {
            "input": source.fingerprint(),
            "method": self.name,
            "parameters": parameters,
            "ratio": self.ratio,
            "num_points": self.num_points,
            "seed": self.seed,
            "layout": LAYOUT,
        }


@dataclass(frozen=True)
class Tiled:
    """Points that lie in a folder.

    Args:
        work: The folder.
        num_original: Originals.
        num_new: New points.
        non_finite: Rows that were left out because a coordinate is not finite.
        repeats: Rows that were left out because they repeat a position.
        origin: What was subtracted from all positions, [3].
        tiles: The number of tiles.
        at_once: Points to give at a time.
        request: What was made.
    """

    work: WorkFolder
    num_original: int
    num_new: int
    non_finite: int
    repeats: int
    origin: tuple[float, float, float]
    tiles: int
    at_once: int
    request: Request

    def originals(self, progress: Progress) -> Iterator[Piece]:
        """The originals, in file order."""
        return originals(self.work, self.at_once, progress)

    def new(self, progress: Progress) -> Iterator[Piece]:
        """The new points, in the order in which they were drawn."""
        if not self.num_new:
            return iter(())
        if isinstance(self.request.method, BoundingBox):
            seed = self.request.seed
            return box_points(self.work, self.num_new, seed, self.at_once, progress)
        return new_points(self.work, self.at_once, progress)

    @property
    def num_repeated(self) -> int:
        """New points that repeat a position, which scenes are written without."""
        return repeats_known(self.work) or 0

    def new_distinct(self, progress: Progress) -> Iterator[Piece]:
        """The new points but for those."""
        first = 0
        for xyz, rgb in self.new(progress):
            kept = ~repeated(self.work, first, first + len(xyz))
            first += len(xyz)
            yield xyz[kept], rgb[kept]

    def all(self, progress: Progress) -> Iterator[Piece]:
        """The originals, then the new points."""
        return chain(self.originals(progress), self.new(progress))


def check_tileable(name: str, method: object, in_memory: str = "work in memory") -> None:
    """Refuse a method that needs more than a point's surroundings.

    Args:
        name: Its name.
        method: The method.
        in_memory: What the user may do instead, for the error.

    Raises:
        ParameterError: It does.
    """
    if isinstance(method, BoundingBox):
        return
    way_out = ""
    if not isinstance(method, NearestMethod):
        reason = f"{name}, which needs the whole scene at once"
    elif method.untileable_reason:
        reason = f"{name} with {method.untileable_reason}, which needs all points at once"
        way_out = f", or {name} with --profile default"
    else:
        return
    raise ParameterError(
        "a method that works tile by tile (linear, triangle, spline, mls, voronoi, random)",
        found=reason,
        fix=f"Choose one of these{way_out}, or {in_memory}.",
    )


def make_tiled(
    work: WorkFolder,
    source: Source,
    request: Request,
    plan: TilePlan,
    tasks: Tasks,
    progress: Progress,
) -> Tiled:
    """Make the new points of a cloud, tile by tile.

    Args:
        work: The folder, which may hold finished steps of the same job.
        source: The cloud.
        request: What to make.
        plan: The size of tiles.
        tasks: What carries out the work on tiles.
        progress: Told the stages.

    Raises:
        ParameterError: The method does not work tile by tile, or the number of points is out of
            range.
        PointCloudError: Too few distinct finite points for the method.
        OSError: The disk is full.
    """
    check_tileable(request.name, request.method)
    if work.facts("read") is None:
        read_rows(work, source.chunks(plan.at_once), source.count, source.trusted, progress)
    if work.facts("split") is None:
        split(work, plan.tile_points, plan.at_once, progress)
    facts, store = work.facts("split") or {}, TileStore(work)
    if facts["most"] > plan.tile_points and store.counts.max() > plan.tile_points:
        raise ParameterError(
            f"memory for tiles of {facts['most']:,} points, as they were cut",
            found=f"enough for {plan.tile_points:,}",
            fix=f"Pass the --memory of the first time, or remove {work.path} to begin anew.",
        )
    num_new = planned_size(store.count, request.ratio, request.num_points) - store.count
    if num_new and isinstance(request.method, NearestMethod):
        _make(work, store, request.method, num_new, request.seed, tasks, progress)
    return Tiled(
        work, store.count, num_new, facts["non_finite"], facts["repeats"],
        tuple(Rows(work).origin.tolist()), len(store), plan.at_once, request,
    )  # fmt: skip


def _make(
    work: WorkFolder,
    store: TileStore,
    method: NearestMethod,
    num_new: int,
    seed: int,
    tasks: Tasks,
    progress: Progress,
) -> None:
    """Weigh all tiles, draw the bases, and make the new points of all tiles."""
    method.check_enough(store.count)
    tiles = [int(tile) for tile in np.flatnonzero(store.counts)]
    path = str(work.path)
    if work.facts("drawn") is None:
        left = [(path, method, tile) for tile in tiles if not work.has(weighed_name(tile))]
        tasks.run_all(weigh, left, "neighbours", progress)
        draw(work, num_new, seed, progress)
    left = [(path, method, tile) for tile in tiles if not work.has(made_name(tile))]
    tasks.run_all(place, left, "new points", progress)
    if repeats_known(work) is None:
        find_repeats(work, store, num_new, progress)
    for name in ("tiles", "weighed", "drawn", "tile_of_rank"):  # the output needs the space
        work.discard(name)


def weigh(path: str, method: NearestMethod, tile: int) -> None:
    """``weigh_tile`` as a task."""
    weigh_tile(WorkFolder(Path(path)), method, tile)


def place(path: str, method: NearestMethod, tile: int) -> None:
    """``place_tile`` as a task, after which what weighing left is not needed."""
    work = WorkFolder(Path(path))
    place_tile(work, method, tile)
    work.discard(weighed_name(tile))
