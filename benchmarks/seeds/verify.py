"""Verify: what it makes of interpolated points where the surfaces are known, and how long it takes.

Notation: points of ``mls`` at 16x are held against the training photographs of a capture; *judged*,
*error* and *off* are those of ``depth.py``, by the depth of the held-out frames; of the made room
the surfaces themselves are known. A *fate* is what verify made of a point: it agrees, lies on a
flat place without texture (bare), is seen by too few photographs (unchecked), or was dropped.
Promise: the captures are only read; speed is measured in a process of its own, on the made room
that ``stereo.py`` keeps.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import tyro
from benchmarks.common.children import call
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.common.memory import status_bytes
from benchmarks.seeds.depth import CAPTURES, FAR, HELD_OUT, RATIO, Truth, at_hand, triangulated
from benchmarks.stereo.speed import prepare_views

import splatseed as ss
from splatseed.errors import SplatseedError
from splatseed.methods.contract import NewPoints
from splatseed.photos.cache import user_cache_dir
from splatseed.photos.visibility import find_visibility
from splatseed.scene import Scene
from splatseed.seeding import verify as module
from splatseed.seeding.photo_methods import MAX_SIZE, read_views
from splatseed.seeding.verify import SETTINGS
from splatseed.synthetic.room import build_room

__all__ = ["whole_run"]

THREADS = 2
MADE = "made room"
"""That of the speed measurement."""
THRESHOLDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
"""Largest costs of a point that stays."""
FINE = 0.01
"""Metres: a second, stricter *off*."""
TARGET = "20 s"
WARM = 2_000


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    points: int = 800_000
    """Interpolated points of the made room; 0 leaves speed out."""
    scenes: tuple[str, ...] = (MADE, *CAPTURES)
    """Scenes whose surfaces are known; none to leave quality out."""
    repeats: int = 3
    """Runs for speed; the best is shown."""
    cache: Path = user_cache_dir().parent / "benchmarks"
    """Where made and triangulated scenes are kept."""


@dataclass(frozen=True, eq=False)
class Held:
    """Points before and after.

    Args:
        before: Positions of all of them, [M, 3].
        after: Positions of those that are left, [K, 3].
        rows: Which of the M these are.
        confidence: Theirs.
    """

    before: np.ndarray
    after: np.ndarray
    rows: np.ndarray
    confidence: np.ndarray


def hold(scene: Scene, new: NewPoints) -> Held:
    """Hold points against photographs at the loosest threshold, and remember which are left.

    What a stricter one leaves can be told by the confidence, which is one minus the cost.
    """
    number = np.arange(len(new.xyz), dtype=np.float32)
    # Sizes are passed on as they are, so that they can count the points.
    given = new._replace(sizes=number)
    images = scene.split(HELD_OUT)[0]
    views = read_views(scene, images, MAX_SIZE, ss.progress.silent)
    with patch.object(module, "SETTINGS", replace(SETTINGS, max_cost=max(THRESHOLDS))):
        left = module.verify(views, images, find_visibility(scene), given)
    return Held(new.xyz, left.xyz, left.sizes.astype(int), left.confidence)


def cells(truth: Truth | Room, xyz: np.ndarray, share: float) -> list[str]:
    """A row: what is left, how much of it is judged, and its errors."""
    judged = truth.judges(xyz)
    error = truth.distance(xyz[judged])
    shares = [f"{share:.0%}", f"{judged.mean():.0%}" if len(xyz) else ""]
    if not len(error):
        return [*shares, "", "", "", ""]
    tail = [f"{1000 * np.median(error):.1f}", f"{1000 * np.percentile(error, 90):.0f}"]
    return [*shares, *tail, f"{(error > FINE).mean():.0%}", f"{(error > FAR).mean():.2%}"]


HEADER = ["left", "judged", "error, mm", "its 90%", "over 1 cm", "off"]


def quality(name: str, cache: Path) -> str:
    """The tables of a capture."""
    scene, truth = load(name, cache)
    cloud = ss.upsample(scene, "mls", ratio=RATIO)
    new = cloud.select(cloud.source != 0)
    held = hold(scene, NewPoints(new.xyz, new.rgb))
    label = f"{name}, {len(new):,} points of mls"
    sfm = ["SfM points", *cells(truth, scene.points.xyz.astype(np.float64), 1.0)]
    first = table([label, *HEADER], [sfm, *fates(truth, held)])
    second = table(["largest cost", *HEADER], thresholds(truth, held))
    return f"{first}\n\n{second}"


class Room:
    """The surfaces of the made room, in place of ``depth.Truth``."""

    surfaces = build_room(np.random.default_rng(0)).surfaces

    def judges(self, xyz: np.ndarray) -> np.ndarray:
        """All points, bool [N]."""
        return np.ones(len(xyz), bool)

    def distance(self, xyz: np.ndarray) -> np.ndarray:
        """From the nearest surface, [N]."""
        return self.surfaces.distance(xyz)


def load(name: str, cache: Path) -> tuple[Scene, Truth | Room]:
    """A scene with points, and what is true of it."""
    if name == MADE:
        return ss.load_scene(prepare_views(cache)), Room()
    scene = triangulated(name, cache)
    return scene, Truth.of(scene, CAPTURES[name])


def fates(truth: Truth | Room, held: Held) -> list[list[str]]:
    """Before and after, and the fates one by one, each where it was and where it is."""
    textureless = held.confidence == np.float32(SETTINGS.textureless_confidence)
    unchecked = np.isnan(held.confidence)
    agree = ~textureless & (held.confidence >= 1.0 - SETTINGS.max_cost)
    kept = agree | textureless | unchecked
    dropped = np.setdiff1d(np.arange(len(held.before)), held.rows[kept])
    clouds = {
        "before": held.before,
        "after": held.after[kept],
        "- not moved": held.before[held.rows[kept]],
        "those that agree": held.after[agree],
        "the same, not moved": held.before[held.rows[agree]],
        "textureless": held.after[textureless],
        "unchecked": held.after[unchecked],
        "dropped": held.before[dropped],
    }
    total = len(held.before)
    return [[arm, *cells(truth, xyz, len(xyz) / total)] for arm, xyz in clouds.items()]


def thresholds(truth: Truth | Room, held: Held) -> list[list[str]]:
    """What agrees by each threshold; what has no cost is left out."""
    textureless = held.confidence == np.float32(SETTINGS.textureless_confidence)
    rows = []
    for most in THRESHOLDS:
        xyz = held.after[~textureless & (held.confidence >= 1.0 - most)]
        label = f"{most}{' (as it is)' if most == SETTINGS.max_cost else ''}"
        rows.append([label, *cells(truth, xyz, len(xyz) / len(held.before))])
    return rows


def print_speed(settings: Settings) -> None:
    """A hundred views, stage by stage."""
    run = call(
        "benchmarks.seeds.verify:whole_run",
        threads=THREADS,
        folder=str(prepare_views(settings.cache)),
        points=settings.points,
        repeats=settings.repeats,
    )
    rows = [[stage, f"{wall:.2f}", f"{cpu:.2f}"] for stage, (wall, cpu) in run["stages"].items()]
    print("### Time\n")
    print(table([f"{settings.points:,} points, {run['views']} views", "best s", "its CPU s"], rows))
    print(
        f"\n{run['originals']:,} originals; {run['left']:,} points are left. Peak memory "
        f"{run['peak'] / 2**30:.2f} GiB, {run['before'] / 2**30:.2f} before verify. "
        f"Target: {TARGET} on {THREADS} cores.\n",
        flush=True,
    )


def whole_run(folder: str, points: int, repeats: int) -> dict[str, Any]:
    """Wall and processor seconds of the quickest run by stage, and memory in bytes."""
    scene = ss.load_scene(folder)
    cloud = ss.upsample(scene, "mls", num_points=points + len(scene.points))
    new = cloud.select(cloud.source != 0)
    given, images = NewPoints(new.xyz, new.rgb), scene.images
    views = read_views(scene, images, MAX_SIZE, ss.progress.silent)
    visibility = find_visibility(scene)
    module.verify(views, images, visibility, NewPoints(new.xyz[:WARM], new.rgb[:WARM]))  # compiles
    before, best = status_bytes("VmRSS"), None
    for _ in range(repeats):
        stages, left = staged(lambda note: module.verify(views, images, visibility, given, note))
        if best is None or stages["all"] < best["all"]:
            best = stages
    return {
        "stages": best,
        "views": len(views),
        "originals": len(scene.points),
        "left": len(left.xyz),
        "before": before,
        "peak": status_bytes("VmHWM"),
    }


def staged(
    work: Callable[[Callable[[str, float], None]], Any],
) -> tuple[dict[str, tuple[float, float]], Any]:
    """Wall and processor seconds of a call's stages, and what it returned.

    A stage's time runs until the next begins.
    """
    begun: list[tuple[str, float, float]] = []

    def note(stage: str, _: float) -> None:
        if not begun or begun[-1][0] != stage:
            begun.append((stage, time.perf_counter(), time.process_time()))

    note("begin", 0.0)
    result = work(note)
    note("end", 1.0)
    stages: dict[str, tuple[float, float]] = {}
    for (stage, wall, cpu), (_, wall_after, cpu_after) in pairwise(begun):
        known = stages.get(stage, (0.0, 0.0))
        stages[stage] = (known[0] + wall_after - wall, known[1] + cpu_after - cpu)
    _, wall, cpu = begun[-1]
    stages["all"] = (wall - begun[0][1], cpu - begun[0][2])
    return stages, result


def main(settings: Settings) -> None:
    """Measure and print."""
    print(f"{describe()}\n")
    if settings.points:
        warn_if_busy()
        print_speed(settings)
    for name in at_hand(settings.scenes):
        print(f"{quality(name, settings.cache)}\n", flush=True)


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
