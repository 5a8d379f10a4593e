"""Speed and memory of every method, beside the targets, the naive loop and a peer.

Notation: a run takes N originals to ratio * N points, arrays in memory to arrays in memory, after
one run of the same kind on a small cloud has loaded the compiled code. Promise: every ratio is of
two times taken in the same run on the same machine and cloud; what could not be measured says why.
Each table is Markdown. See README.md for what is and is not measured.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from benchmarks.common.clouds import REAL_SCENES, find_scenes, load_cloud, room
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.common.memory import peak_bytes_per_output
from benchmarks.common.skipping import or_skip
from benchmarks.upsampling.end_to_end import cli_seconds, interpreter_seconds
from benchmarks.upsampling.naive import seconds_per_point
from benchmarks.upsampling.peer_pcl import MODES, build, run as run_peer

import splatseed as ss
from splatseed.errors import SplatseedError

__all__: list[str] = []

Method = Literal["linear", "triangle", "mls", "spline", "voronoi", "random"]

OPTIONS: dict[str, dict[str, Any]] = {
    "linear": {"method": "linear"},
    "triangle": {"method": "triangle"},
    "mls": {"method": "mls"},
    "spline": {"method": "spline"},
    "voronoi": {"method": "voronoi"},
    "random": {"method": "random"},
}
"""What each method of the tables is to ``splatseed.upsample``."""

SECONDS_TARGETS = {
    115_000: {"linear": 0.5, "triangle": 0.5, "mls": 0.5, "spline": 1.5, "spline gcv": 6.0}
    | {"voronoi": 2.0},
    1_000_000: {"linear": 2.0, "triangle": 2.0, "mls": 3.0, "voronoi": 12.0},
}
"""Wall seconds on two cores, by number of originals."""

NAIVE_TARGET = 100.0
BYTES_TARGET = 200.0
CLI_TARGET = 3.0
CLI_RUN = ("bonsai", "mls", 8.0)
LARGE = 1_000_000
WARM_UP_POINTS = 2_000


@dataclass(frozen=True)
class Settings:
    """What to measure; the core table always, the other measurements by switch."""

    sizes: tuple[int, ...] = (115_000, LARGE)
    """Originals of the made room: 16x below a million, 4x from there on."""
    methods: tuple[Method, ...] = tuple(OPTIONS)  # type: ignore[assignment]  # its keys are the literals
    """Which methods."""
    cloud: str = "room"
    """The made room at every size, or one real capture as it is, 16x (bonsai, fox, ...)."""
    repeats: int = 3
    """Runs of each kind; the best and the median are shown."""
    naive_sample: int = 2_000
    """New points of the naive loop; 0 leaves it out."""
    memory: bool = True
    """Peak memory, in one process for each method and size."""
    cli: bool = False
    """Also the command line end to end on the bonsai capture."""
    pcl: bool = False
    """Also the Point Cloud Library's moving least squares, where it is installed."""


@dataclass(frozen=True, eq=False)
class Workload:
    """A cloud and how far to upsample it."""

    cloud: ss.PointCloud
    ratio: float

    @property
    def num_new(self) -> int:
        """New points of a run."""
        return round(self.ratio * len(self.cloud)) - len(self.cloud)

    def __str__(self) -> str:
        return f"{len(self.cloud):,} points to {self.ratio:g}x"


def workloads(settings: Settings) -> Iterator[Workload]:
    """The clouds to run on, each made when its turn comes."""
    if settings.cloud != "room":
        yield Workload(load_cloud(settings.cloud), 16.0)
        return
    for num in settings.sizes:
        yield Workload(room(num), 4.0 if num >= LARGE else 16.0)


def wall_seconds(work: Workload, options: dict[str, Any], repeats: int) -> list[float]:
    """Wall time of each of ``repeats`` warm runs."""
    ss.upsample(work.cloud.select(slice(WARM_UP_POINTS)), ratio=2, **options)
    seconds = []
    for seed in range(repeats):
        started = time.perf_counter()
        ss.upsample(work.cloud, ratio=work.ratio, seed=seed, **options)
        seconds.append(time.perf_counter() - started)
    return seconds


def method_row(work: Workload, method: Method, settings: Settings) -> list[str]:
    """One line of the core table."""
    seconds = wall_seconds(work, OPTIONS[method], settings.repeats)
    target = SECONDS_TARGETS.get(len(work.cloud), {}).get(method)
    best = min(seconds)
    return [
        method,
        f"{best:.2f}",
        f"{statistics.median(seconds):.2f}",
        "" if target is None else f"{target:g}",
        f"{1e6 * best / work.num_new:.2f}",
        *_naive_cells(work, method, best / work.num_new, settings.naive_sample),
        _memory_cell(work, method) if settings.memory else "",
    ]


def _naive_cells(work: Workload, method: Method, ours: float, sample: int) -> list[str]:
    if sample == 0:
        return ["", ""]
    naive = seconds_per_point(method, work.cloud, work.num_new, sample)
    return [f"{1e6 * naive:.0f}", f"{naive / ours:.0f}x"]


def _memory_cell(work: Workload, method: Method) -> str:
    return f"{peak_bytes_per_output(work.cloud, work.ratio, OPTIONS[method]):.0f}"


def print_methods(work: Workload, settings: Settings) -> None:
    """The core table of one workload."""
    header = ["method", "best s", "median s", "target s", "us/new point", "naive us/point"]
    header += [f"naive/ours (target {NAIVE_TARGET:g}x)", f"peak B/point (target {BYTES_TARGET:g})"]
    rows = [method_row(work, method, settings) for method in settings.methods]
    print(f"### {settings.cloud}, {work}\n\n{table(header, rows)}\n")


def print_peer(work: Workload, settings: Settings) -> None:
    """Ours and PCL's moving least squares on the same cloud."""
    ours = min(wall_seconds(work, OPTIONS["mls"], settings.repeats))
    rows = [_peer_row("splatseed mls, with colours", work.num_new, ours)]
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        for mode in MODES:
            peer = run_peer(program, work.cloud, mode, work.ratio, settings.repeats)
            rows.append(_peer_row(f"PCL {mode}, no colours", peer.num_points, peer.seconds))
    header = ["moving least squares", "new points", "best s", "M points/s"]
    print(f"### Peer: {settings.cloud}, {work}\n\n{table(header, rows)}\n")


def _peer_row(name: str, num_new: int, seconds: float) -> list[str]:
    return [name, f"{num_new:,}", f"{seconds:.2f}", f"{num_new / seconds / 1e6:.2f}"]


def print_cli(repeats: int) -> None:
    """The command line end to end."""
    name, method, ratio = CLI_RUN
    runs = cli_seconds(find_scenes() / REAL_SCENES[name], method, ratio, repeats)
    idle = min(interpreter_seconds(repeats))
    header = ["command line", "best s", "median s", "interpreter s", "best less it", "target s"]
    row = [f"upsample {name} --method {method} --ratio {ratio:g}"]
    numbers = (min(runs), statistics.median(runs), idle, min(runs) - idle, CLI_TARGET)
    print(table(header, [row + [f"{number:.2f}" for number in numbers]]) + "\n")


def main(settings: Settings) -> None:
    """Measure and print."""
    print(f"{describe()}\n")
    warn_if_busy()
    for work in workloads(settings):
        print_methods(work, settings)
        if settings.pcl:
            or_skip("peer", lambda work=work: print_peer(work, settings))
    if settings.cli:
        or_skip("command line", lambda: print_cli(settings.repeats))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
