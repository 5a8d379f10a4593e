"""How fast cover is: 100 views of 800 x 600 in a made room, beside coverage in plain NumPy."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import tyro
from benchmarks.common.clouds import room
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table

from splatseed.camera import Camera
from splatseed.errors import SplatseedError
from splatseed.photos.view import View
from splatseed.photos.viewpoint import look_at
from splatseed.photos.visibility import SURFACE
from splatseed.photos.zbuffer import MIN_NEARER
from splatseed.seeding.cover import cover, covered_share
from splatseed.seeding.thinning import thin

__all__: list[str] = []

WIDTH, HEIGHT, FOCAL = 800, 600, 700.0
CELL = 8
SPARSE = 20
"""For the row where most cells are empty, one of so many points is kept."""


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    views: int = 100
    """Views within the room."""
    points: int = 200_000
    """Points of the room; five times as many for thinning."""
    repeats: int = 3
    """Runs; the best is shown."""


def views_of_the_room(num: int) -> list[View]:
    """Views from places on an ellipse within the room, across it."""
    rng = np.random.default_rng(0)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    views = []
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, num, endpoint=False)):
        eye = np.array([1.5 * np.cos(angle), 1.2 * np.sin(angle), 1.3])
        target = np.array([2.5 * np.cos(angle + 2.5), 2.0 * np.sin(angle + 2.5), 1.0])
        pose = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
        views.append(View(f"{k}", pixels, Camera(K, WIDTH, HEIGHT, pose)))
    return views


def numpy_share(views: Sequence[View], xyz: np.ndarray) -> float:
    """``covered_share`` as one would write it with NumPy."""
    return float(np.mean([_numpy_cells(view, xyz).mean() for view in views]))


def _numpy_cells(view: View, xyz: np.ndarray) -> np.ndarray:
    (rows, cols), m = view.camera.grid_shape(CELL), view.camera.cells_from_world(CELL)
    x, y, depth = m[:, :3] @ xyz.T.astype(np.float64) + m[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        j, i = np.floor(x / depth), np.floor(y / depth)
    inside = (depth > 0) & (j >= 0) & (j < cols) & (i >= 0) & (i < rows)
    cells = (i[inside] * cols + j[inside]).astype(np.int64)
    order = np.lexsort((depth[inside], cells))
    held, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    depths = np.full(rows * cols, np.inf)
    depths[held] = depth[inside][order][first + count // 4]
    framed = np.pad(depths.reshape(rows, cols), 1, constant_values=np.inf)
    around = np.lib.stride_tricks.sliding_window_view(framed, (3, 3)).reshape(rows, cols, 9)
    limit = depths.reshape(rows, cols, 1) * (1 - SURFACE)
    return np.isfinite(depths.reshape(rows, cols)) & ((around < limit).sum(axis=2) < MIN_NEARER)


def best_seconds(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Wall and processor seconds of the quickest of some runs."""
    runs = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        runs.append((time.perf_counter() - wall, time.process_time() - cpu))
    return min(runs)


def print_speed(settings: Settings) -> None:
    """Coverage, cover and thinning."""
    views, xyz = views_of_the_room(settings.views), room(settings.points).xyz
    cover(views[:2], xyz[:1000], rng=np.random.default_rng(0))
    thin(xyz[:1000], views, 100)
    share, sparse = covered_share(views, xyz), xyz[::SPARSE]
    works: dict[str, tuple[Callable[[], object], str]] = {
        f"coverage ({100 * share:.0f}%)": (lambda: covered_share(views, xyz), "1"),
        "the same in NumPy": (lambda: numpy_share(views, xyz), ""),
    }
    for points in (xyz, sparse):
        covered, new = covered_share(views, points), len(_cover(views, points))
        name = f"cover, {100 * covered:.0f}% covered, {new:,} new"
        works[name] = (lambda points=points: _cover(views, points), "1")
    many = room(5 * settings.points).xyz
    works[f"thin {len(many):,} to {settings.points:,}"] = (
        lambda: thin(many, views, settings.points),
        "",
    )
    rows = []
    for name, (work, target) in works.items():
        wall, cpu = best_seconds(work, settings.repeats)
        rows.append([name, f"{wall:.2f}", f"{cpu:.2f}", target])
    header = [
        f"{settings.views} views, {settings.points:,} points",
        "best s",
        "its CPU s",
        "target s",
    ]
    print(f"### Time\n\n{table(header, rows)}\n")
    ratio = float(rows[1][2]) / float(rows[0][2])
    print(f"Coverage takes 1/{ratio:.0f} of NumPy's processor time.\n")


def _cover(views: Sequence[View], xyz: np.ndarray) -> np.ndarray:
    return cover(views, xyz, cell=CELL, rng=np.random.default_rng(0)).xyz


def main(settings: Settings) -> None:
    """Measure and print."""
    print(f"{describe()}\n")
    warn_if_busy()
    print_speed(settings)


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
