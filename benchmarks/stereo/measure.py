"""Depth from photographs alone: speed, and accuracy against exact depth.

Notation: see ``speed`` and ``truth``. Promise: every measurement has its own process; tables are
Markdown. Without captures, the parts that need them are skipped with the reason.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from benchmarks.common.children import avx2_environment, call
from benchmarks.common.clocks import Clock
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.seeds.depth import at_hand
from benchmarks.stereo.speed import NUM_VIEWS, prepare_views
from benchmarks.stereo.truth import TRUE_SCENES, Score, prepare

from splatseed.errors import ParameterError, SplatseedError
from splatseed.photos.loading import user_cache_dir

__all__: list[str] = []

HYPOTHESIS_TARGET, PEER_TARGET, AVX2_TARGET = 0.4, 3.3, 1.5
"""Microseconds of ours and of the peer, and AVX2's over AVX-512's."""
WHOLE_TARGET = "30 s, 2 GB"
THREADS = 2
PEER_ROWS = 40
PARTS = ("speed", "whole", "truth")
STARTS = {"SfM's points": "", "no points": "depths", "depth maps": "points"}
"""Starts of stereo, and what is removed from the scene."""


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    parts: tuple[str, ...] = PARTS
    """speed: a hypothesis; whole: 100 views; truth: accuracy against exact depth."""
    scenes: tuple[str, ...] = TRUE_SCENES
    """Where depth is known."""
    limit: int = 48
    """Maximum number of photographs of a scene."""
    clock: Clock = "wall"
    """On a machine that is not idle, cpu: processor time over threads."""
    cache: Path = user_cache_dir().parent / "benchmarks"
    """Where made and triangulated scenes are kept."""

    def __post_init__(self) -> None:
        known = {"parts": PARTS, "scenes": TRUE_SCENES}
        for name, all_of_them in known.items():
            for each in getattr(self, name):
                if each not in all_of_them:
                    raise ParameterError(
                        f"--{name} of {', '.join(all_of_them)}", found=each, fix="Correct the name."
                    )


def print_speed(_: Settings) -> None:
    """A hypothesis with AVX-512 and AVX2, beside the scalar loop."""
    codes: dict[str, Any] = {"the processor's best": None}
    if avx2 := avx2_environment():
        codes = {"AVX-512": None, "AVX2": avx2}
    seconds_of = {}
    with tempfile.TemporaryDirectory() as folder:
        for code, environment in codes.items():
            variables = {**(environment or {}), "NUMBA_CACHE_DIR": folder}
            seconds_of[code] = call(
                "benchmarks.stereo.speed:hypothesis_seconds",
                threads=1,
                environment=variables,
                peer_rows=PEER_ROWS,
            )
    rows = [
        [code, *(f"{1e6 * each[name]:.2f}" for name in ("planes", "sweep", "peer")),
         f"{each['peer'] / each['planes']:.1f}x", f"{each['peer'] / each['sweep']:.1f}x"]
        for code, each in seconds_of.items()
    ]  # fmt: skip
    header = ["instructions", "planes, us", "in a sweep, us", "scalar loop, us"]
    header += ["loop over planes", "loop over sweep"]
    print("### A hypothesis: five sources of 25 samples, one thread\n")
    print(table(header, rows))
    target = f"{HYPOTHESIS_TARGET} us against {PEER_TARGET}; AVX2 {AVX2_TARGET} times slower"
    print(f"\nTargets: {target}. Costs differ by at most {seconds_of[code]['gap']:.0e}.\n")


def print_whole(settings: Settings) -> None:
    """A hundred views, stage by stage, with and without points."""
    folder = prepare_views(settings.cache)
    runs = [
        call(
            "benchmarks.stereo.speed:whole_run", threads=THREADS, folder=str(folder),
            clock=settings.clock, threads_used=THREADS, points=points,
        )
        for points in (True, False)
    ]  # fmt: skip
    stages = [run["stages"] for run in runs]
    rows = [[name, *(f"{each[name]:.1f}" for each in stages)] for name in stages[0]]
    totals = [sum(each.values()) - each["read images"] for each in stages]
    rows += [["all but reading", *(f"{total:.1f}" for total in totals)]]
    rows += [["seeds", *(f"{run['seeds']:,}" for run in runs)]]
    rows += [["peak memory, GiB", *(f"{run['peak'] / 2**30:.2f}" for run in runs)]]
    print(f"### {NUM_VIEWS} views of 800 x 600, every 4th pixel, {THREADS} threads\n")
    print(table(["seconds", "with points", "without"], rows))
    print(f"\nTarget: {WHOLE_TARGET}; without points 60 s.\n", flush=True)


def print_truth(settings: Settings) -> None:
    """Accuracy with SfM's points, without, and with depth maps instead."""
    names = at_hand(settings.scenes)
    prepare(names, settings.cache)
    arguments = {"names": names, "cache": str(settings.cache), "limit": settings.limit}
    scores_of = {
        start: call(
            "benchmarks.stereo.truth:score_all", threads=THREADS, without=without, **arguments
        )
        for start, without in STARTS.items()
    }
    header = ["started from", "kept", "within 1%", "within 5%", "reached", "CPU s"]
    for name in names:
        rows = [[start, *Score(**scores[name]).cells()] for start, scores in scores_of.items()]
        print(f"{table([f'{name}: {header[0]}', *header[1:]], rows)}\n", flush=True)


PRINTERS: dict[str, Callable[[Settings], None]] = {
    "speed": print_speed,
    "whole": print_whole,
    "truth": print_truth,
}


def main(settings: Settings) -> None:
    """Measure and print."""
    print(f"{describe()}; clock: {settings.clock}\n")
    if settings.clock == "wall":
        warn_if_busy()
    for part in settings.parts:
        PRINTERS[part](settings)


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
