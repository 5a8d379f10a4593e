"""Rules for the depth of an empty cell, held against points that were taken away.

Notation: a *hole* is a view's own pattern of empty cells, moved so that an empty cell of it falls
on a point that the view's track proves to be visible; what the hole hides is hidden from all views.
The error is |log(guess / depth)| of that point. Promise: test views and validation views are not
read; a rule sees what ``cover`` would see.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from benchmarks.common.clouds import find_scenes
from benchmarks.common.markdown import table
from scipy.spatial import Delaunay, QhullError

from splatseed.io import load_scene
from splatseed.photos import projection, zbuffer
from splatseed.photos.view import View, camera_views
from splatseed.progress import silent
from splatseed.scene import Image, Scene
from splatseed.seeding import cover

__all__ = ["rule_table"]

CELL = 8
TEST_EVERY = 8
DATA_FACTOR = 2
MOST_VIEWS = 14
MOST_WITNESSES = 12
NEAREST = 9
FEW = 12
"""Holes that leave fewer covered cells than this say nothing."""


@dataclass(frozen=True, eq=False)
class Hole:
    """A cell to guess the depth of, and what may be known for it.

    Args:
        quartiles: Depths of the view's covered cells, infinite in the hole and where not covered.
        fronts: The same as the nearest depth in each cell.
        cell: Row and column to guess.
        truth: The depth that was taken away.
        view: Whose it is.
        witnesses: Other views' cells without the points in the hole.
    """

    quartiles: np.ndarray
    fronts: np.ndarray
    cell: tuple[int, int]
    truth: float
    view: View
    witnesses: cover.ReferenceDepths

    def sectors(self, num_witnesses: int) -> float:
        """The rule of ``cover``, asking some of the other views."""
        depths, _ = cover.guess_depths(
            self.quartiles,
            np.array([self.cell[0] * self.quartiles.shape[1] + self.cell[1]]),
            cover.world_from_cells(self.view, CELL),
            self.witnesses,
            np.arange(num_witnesses),
        )
        return float(depths[0])


def _nearest(depths: np.ndarray, cell: tuple[int, int], num: int) -> np.ndarray:
    """1 / depth of the nearest covered cells, nearest first."""
    i, j = np.nonzero(np.isfinite(depths))
    order = np.argsort((i - cell[0]) ** 2 + (j - cell[1]) ** 2, kind="stable")[:num]
    return np.asarray(1 / depths[i[order], j[order]])


def _linear(depths: np.ndarray, cell: tuple[int, int]) -> float:
    """Linear in 1 / depth on the Delaunay triangulation.

    The median of the nearest outside of it.
    """
    known = np.argwhere(np.isfinite(depths))
    near = known[np.argsort(((known - cell) ** 2).sum(axis=1), kind="stable")[:400]]
    try:
        mesh = Delaunay(near)
        k = int(mesh.find_simplex(np.array(cell, float)))
    except QhullError:
        k = -1
    if k < 0:
        return float(1 / np.median(_nearest(depths, cell, NEAREST)))
    two = mesh.transform[k, :2] @ (np.array(cell) - mesh.transform[k, 2])
    corners = near[mesh.simplices[k]]
    return float(1 / (np.append(two, 1 - two.sum()) @ (1 / depths[corners[:, 0], corners[:, 1]])))


RULES = {
    "median of 9 nearest, z-buffer": lambda h: 1 / np.median(_nearest(h.fronts, h.cell, NEAREST)),
    "median of 9 nearest": lambda h: 1 / np.median(_nearest(h.quartiles, h.cell, NEAREST)),
    "their third, farther": lambda h: (
        1 / np.quantile(_nearest(h.quartiles, h.cell, NEAREST), 1 / 3)
    ),
    "nearest": lambda h: 1 / _nearest(h.quartiles, h.cell, 1)[0],
    "linear on Delaunay's triangles": lambda h: _linear(h.quartiles, h.cell),
    "8 sectors": lambda h: h.sectors(0),
    "8 sectors, other views asked": lambda h: h.sectors(len(h.witnesses.starts)),
}
"""A hole to a depth; the last is what ``cover`` does."""


def rule_table(scenes: Sequence[str], holes: int) -> str:
    """Median and 90th percentile of each rule's errors by capture."""
    cells = {name: _errors(name, holes) for name in scenes}
    rows = [[rule, *(_cell(errors[rule]) for errors in cells.values())] for rule in RULES]
    return table(["median, 90th percentile", *scenes], rows)


def _cell(errors: Sequence[float]) -> str:
    return f"{100 * np.median(errors):.1f}%, {100 * np.quantile(errors, 0.9):.0f}%"


def _errors(name: str, holes: int) -> Mapping[str, list[float]]:
    scene = load_scene(find_scenes() / name)
    errors: dict[str, list[float]] = {rule: [] for rule in RULES}
    for hole in make_holes(scene, holes):
        for rule, guessed in RULES.items():
            errors[rule].append(abs(float(np.log(guessed(hole) / hole.truth))))
    return errors


def make_holes(scene: Scene, num: int) -> Iterator[Hole]:
    """Holes in some of the views that are trained on."""
    rng = np.random.default_rng(0)
    rest = scene.split(TEST_EVERY)[0]
    images = [image for k, image in enumerate(rest) if k % TEST_EVERY]
    views = camera_views(images, DATA_FACTOR)
    for v in rng.permutation(len(views))[:MOST_VIEWS]:
        others = [o for o in rng.permutation(len(views)) if o != v][:MOST_WITNESSES]
        asked = [views[o] for o in others]
        visible = _observed(scene, images[v])
        for _ in range(num if len(visible) else 0):
            hole = _make_hole(scene.points.xyz, views[v], asked, rng.choice(visible), rng)
            if hole is not None:
                yield hole


def _observed(scene: Scene, image: Image) -> np.ndarray:
    """The rows of the points that a track proves to be visible in an image."""
    if scene.tracks is None or image.observations is None:
        return np.empty(0, np.int64)
    ids = image.observations.point_ids
    return np.flatnonzero(np.isin(scene.tracks.point_ids, ids[ids >= 0]))


def _make_hole(
    xyz: np.ndarray, view: View, asked: Sequence[View], row: int, rng: np.random.Generator
) -> Hole | None:
    place, depth = _cells_of(view, xyz)
    quartiles = zbuffer.cell_depths(view.camera, xyz, CELL)
    covered = np.isfinite(quartiles)
    empty = np.argwhere(~covered)
    target = place[row]
    if not len(empty) or not (depth[row] > 0 and _inside(target, covered.shape)):
        return None
    known = covered & _moved(covered, target - empty[rng.integers(len(empty))])
    known[tuple(target)] = False
    if np.count_nonzero(known) < FEW:
        return None
    within = _inside(place, covered.shape) & (depth > 0)
    hidden = within.copy()
    hidden[within] = ~known[tuple(place[within].T)]
    rest = np.ascontiguousarray(xyz[~hidden])
    fronts = np.full(covered.shape, np.inf)
    np.minimum.at(fronts, tuple(place[within & ~hidden].T), depth[within & ~hidden])
    return Hole(
        np.where(known, quartiles, np.float32(np.inf)),
        fronts,
        (int(target[0]), int(target[1])),
        float(depth[row]),
        view,
        cover.reference_depths(asked, rest, CELL, silent),
    )


def _cells_of(view: View, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of each point's cell, int64 [N, 2], and its depth."""
    m = projection.cells_from_world(view.camera, CELL)
    x, y, depth = m[:, :3] @ xyz.T.astype(np.float64) + m[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = np.floor(np.stack([y / depth, x / depth], axis=1))
    return np.nan_to_num(place, nan=-1).clip(-1, 1 << 30).astype(np.int64), depth


def _inside(place: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return ((place >= 0) & (place < shape)).all(axis=-1)


def _moved(covered: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The pattern moved by some rows and columns; what comes in from outside is not covered."""
    place = np.stack(np.indices(covered.shape), axis=-1) - step
    inside = _inside(place, covered.shape)
    moved = np.zeros_like(covered)
    moved[inside] = covered[tuple(place[inside].T)]
    return moved
