"""Upsampling larger than memory: seconds per point and peak memory, tile by tile against in memory.

A made room of N points in a PLY becomes 4 N points. Every run is the command in a process of its
own, from file to files, as a user would run it. Promise: ratios are of runs of the same program on
the same machine, one after another; fewer of the same points are upsampled in memory before the
tiles and after them, as a machine's pace changes. See README.md for what was measured.

    python -m benchmarks.scale.tiles WORK                       # 100 M points to 400 M
    python -m benchmarks.scale.tiles WORK --limit 2000000       # a try
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from benchmarks.common.children import thread_settings
from benchmarks.common.clouds import room_surfaces
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.common.memory import FamilyWatch

from splatseed.io.ply import ply_header, ply_rows

__all__: list[str] = []

PROGRAM = "import sys; from splatseed.cli import main; main(sys.argv[1:])"
CHUNK = 1_000_000
NOISE, GHOSTS = 0.002, 0.003
SMALL = 16_000_000
"""Fewer points than this get smaller tiles, so that there are several."""
HEADER = ("", "points", "seconds", "CPU s", "us a point", "peak GB", "tiles to it")
MEMORY_TARGET, RATE_TARGET, WORKERS_TARGET = 4.0, 1.5, 1.7


@dataclass(frozen=True)
class Options:
    """Upsample a made room tile by tile and in memory, and compare."""

    work: Annotated[Path, tyro.conf.Positional]
    """Where files are made; outputs are removed, clouds are kept and used again."""
    limit: int = 100_000_000
    """Points of the cloud."""
    in_memory: int = 16_000_000
    """Points of the runs in memory, which takes 9 GB for 16 million."""
    methods: tuple[Literal["linear", "triangle", "mls", "spline", "voronoi"], ...] = (
        "linear",
        "mls",
    )
    """Methods to run."""
    memory: str = "4G"
    """The bound."""
    threads: int = 2
    """Threads of a run, or processes of one each."""
    workers: int = 16_000_000
    """Points of the runs by one and by two Ray workers, at most the limit; 0 leaves them out."""


@dataclass(frozen=True)
class Run:
    """What one run of the command took.

    Args:
        points: Points that it started from.
        wall: Seconds.
        busy: Seconds of all its threads and processes.
        peak: Most bytes that its processes held at a time.
        stages: Seconds of each stage.
    """

    points: int
    wall: float
    busy: float
    peak: int
    stages: dict[str, float]

    @property
    def rate(self) -> float:
        """Microseconds for each point that there was."""
        return 1e6 * self.wall / self.points

    @property
    def in_tiles(self) -> float:
        """Seconds of the work on tiles alone."""
        return self.stages["neighbours"] + self.stages["new points"]


def make_cloud(path: Path, count: int) -> Path:
    """Write a room's points, if the file is not there."""
    if path.exists():
        return path
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        file.write(ply_header(count))
        for first in range(0, count, CHUNK):
            file.write(ply_rows(*_points(min(CHUNK, count - first), first)))
    partial.rename(path)
    return path


def _points(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xyz = room_surfaces().sample(count, rng) + rng.normal(scale=NOISE, size=(count, 3))
    ghosts = rng.random(count) < GHOSTS
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    xyz[ghosts] = rng.uniform(low, high, (int(ghosts.sum()), 3))
    return xyz.astype(np.float32), rng.integers(0, 256, (count, 3), np.uint8)


def upsample(cloud: Path, points: int, method: str, threads: int, words: Sequence[str]) -> Run:
    """Run the command, to an output that is removed again."""
    out = cloud.with_name("OUT")
    shutil.rmtree(out, ignore_errors=True)
    command = ["upsample", str(cloud), "-o", str(out), "--method", method, "--ratio", "4", *words]
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM, *command], stdout=subprocess.PIPE, text=True,
        env={**os.environ, **thread_settings(threads)},
    )  # fmt: skip
    assert process.stdout is not None  # noqa: S101  (asked for above)
    with FamilyWatch(process.pid) as memory:
        text = process.stdout.read()
    before = _children_seconds()
    code = process.wait()
    wall, busy = time.perf_counter() - started, _children_seconds() - before
    shutil.rmtree(out, ignore_errors=True)
    if code:
        raise SystemExit(f"{' '.join(command)} ended with {code}")
    told = re.search(r"^  seconds +(.*)$", text, re.MULTILINE)
    stages = {} if told is None else dict(_stages(told[1]))
    return Run(points, wall, busy, memory.peak, stages)


def _children_seconds() -> float:
    import resource  # noqa: PLC0415  (not on Windows)

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _stages(text: str) -> Iterator[tuple[str, float]]:
    for part in text.split(", "):
        name, _, seconds = part.rpartition(" ")
        yield name, float(seconds)


def compare(options: Options) -> None:
    """Print a table of each method's runs in memory and tile by tile."""
    small = make_cloud(options.work / f"room_{options.in_memory}.ply", options.in_memory)
    large = make_cloud(options.work / f"room_{options.limit}.ply", options.limit)
    pieces = ["--tile-points", str(options.limit // 16)] if options.limit < SMALL else []
    for method in options.methods:
        _warm_up(options, small, method)
        before = upsample(small, options.in_memory, method, options.threads, [])
        words = ["--memory", options.memory, "--jobs", str(options.threads), *pieces]
        tiled = upsample(large, options.limit, method, options.threads, words)
        after = upsample(small, options.in_memory, method, options.threads, [])
        runs = {"in memory, before": before, "tiles": tiled, "in memory, after": after}
        print(f"{method}: {', '.join(f'{n} {s:.1f}' for n, s in tiled.stages.items())}\n")
        print(table(HEADER, [_row(name, run, tiled) for name, run in runs.items()]), flush=True)
    print(f"\nTargets: peak {MEMORY_TARGET:.0f} GB, {RATE_TARGET} times the rate in memory.\n")


def _row(name: str, run: Run, tiled: Run) -> tuple[str, ...]:
    return (
        name, f"{run.points:,}", f"{run.wall:.1f}", f"{run.busy:.1f}", f"{run.rate:.2f}",
        f"{run.peak / 2**30:.2f}", "" if run is tiled else f"{tiled.rate / run.rate:.2f}",
    )  # fmt: skip


def _warm_up(options: Options, small: Path, method: str) -> None:
    """Compile what either way needs."""
    tiny = make_cloud(small.with_name("room_20000.ply"), 20_000)
    for words in ([], ["--tile-points", "8000"]):
        upsample(tiny, 20_000, method, options.threads, words)


def compare_workers(options: Options) -> None:
    """Print a table of one and of two Ray workers."""
    count = min(options.workers, options.limit)
    cloud = make_cloud(options.work / f"room_{count}.ply", count)
    rows = []
    for method in options.methods:
        words = ["--executor", "ray", "--tile-points", str(count // 16)]
        one, two = (
            upsample(cloud, count, method, 1, [*words, "--jobs", str(jobs)]) for jobs in (1, 2)
        )
        rows.append((
            method, f"{count:,}", f"{one.in_tiles:.1f}", f"{two.in_tiles:.1f}",
            f"{one.in_tiles / two.in_tiles:.2f}", f"{one.wall:.1f}", f"{two.wall:.1f}",
            f"{one.wall / two.wall:.2f}",
        ))  # fmt: skip
    header = ("method", "points", "tiles, 1", "tiles, 2", "times", "all, 1", "all, 2", "times")
    print(table(header, rows))
    print(f"Seconds of work on tiles, and of the command. Target: {WORKERS_TARGET} times.\n")


def main(options: Options) -> None:
    """Make the clouds, run, and print."""
    warn_if_busy()
    print(describe())
    options.work.mkdir(parents=True, exist_ok=True)
    compare(options)
    if options.workers:
        compare_workers(options)


if __name__ == "__main__":
    main(tyro.cli(Options))
    sys.exit()
