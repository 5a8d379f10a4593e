"""Depth from photographs alone: how fast, how near the truth, and what each choice gives.

Notation: see ``speed``, ``truth``, ``points`` and ``semi_global``, where the measuring is done.
Promise: every measurement has a process of its own; each table is Markdown. What needs captures is
left out, with the reason, where there are none. See README.md for what is and is not measured.
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from benchmarks.common.children import avx2_environment, call
from benchmarks.common.clocks import Clock
from benchmarks.common.clouds import find_scenes
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.seeds.depth import at_hand
from benchmarks.stereo.arms import ARMS, FOLIAGE, Arm, scores_of
from benchmarks.stereo.points import FEW, PointScore
from benchmarks.stereo.speed import NUM_VIEWS, prepare_views
from benchmarks.stereo.truth import TRUE_SCENES, Score, prepare

from splatseed.errors import ParameterError, SplatseedError
from splatseed.photos.cache import user_cache_dir

__all__: list[str] = []

HYPOTHESIS_TARGET, PEER_TARGET, AVX2_TARGET = 0.4, 3.3, 1.5
"""Microseconds of ours and of the peer, and AVX2's over AVX-512's."""
WHOLE_TARGET = "30 s, 2 GB"
THREADS = 2
PEER_ROWS = 40
POINTS_OF = ("treehill", "fern", "fox", "bonsai")
PARTS = ("speed", "whole", "truth", "pairs", "points", "few", "bare", "foliage", "dense")


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    parts: tuple[str, ...] = PARTS
    """speed: a hypothesis; whole: 100 views; truth: against true depth; pairs: OpenCV's semi-global
    matching, likewise; points: against SfM's points; few: begun from a few of these; bare: without
    points; foliage: treehill; dense: seeds within budgets."""
    scenes: tuple[str, ...] = TRUE_SCENES
    """Where depth is known."""
    arms: tuple[str, ...] = tuple(ARMS)
    """Which choices."""
    captures: tuple[str, ...] = POINTS_OF
    """Where SfM's points are known."""
    limit: int = 48
    """Photographs of a scene at most where depth is known; elsewhere half of it."""
    clock: Clock = "wall"
    """On a machine that is not idle, cpu: processor time over threads."""
    cache: Path = user_cache_dir().parent / "benchmarks"
    """Where made and triangulated scenes are kept."""

    def __post_init__(self) -> None:
        known = {"parts": PARTS, "scenes": TRUE_SCENES, "arms": tuple(ARMS)}
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
    """Every arm against true depth."""
    names = at_hand(settings.scenes)
    prepare(names, settings.cache)
    arguments = {"cache": str(settings.cache), "limit": settings.limit}
    header = ["kept", "within 1%", "within 5%", "reached", "CPU s"]
    _print_arms("benchmarks.stereo.truth:score_all", Score, names, settings.arms, header, arguments)


def print_pairs(settings: Settings) -> None:
    """Ours beside OpenCV's semi-global matching of rectified pairs, against true depth."""
    if importlib.util.find_spec("cv2") is None:
        print("No peer: OpenCV is not installed (pip install opencv-python-headless).\n")
        return
    names = at_hand(settings.scenes)
    prepare(names, settings.cache)
    arguments: dict[str, Any] = {
        "names": names, "cache": str(settings.cache), "limit": settings.limit,
    }  # fmt: skip
    pairs = "benchmarks.stereo.semi_global:score_pairs"
    scores = {
        "stereo": scores_of(ARMS["stereo"], "benchmarks.stereo.truth:score_all", **arguments),
        "one rectified pair": scores_of(Arm(), pairs, pairs=1, **arguments),
        "two that agree": scores_of(Arm(), pairs, pairs=2, **arguments),
    }
    header = ["kept", "within 1%", "within 5%", "reached", "CPU s"]
    for name in names:
        rows = [[label, *Score(**each[name]).cells()] for label, each in scores.items()]
        print(f"{table([name, *header], rows)}\n", flush=True)


def print_points(settings: Settings) -> None:
    """Every arm against SfM's points."""
    _print_against_points(settings, settings.captures, settings.arms)


def print_few(settings: Settings) -> None:
    """From which number on SfM's points show better where to search than small photographs do."""
    find_scenes()
    header = ["begun from", "seen by an image", "kept", "CPU s"]
    for name in settings.captures:
        found = call(
            "benchmarks.stereo.points:score_few", threads=1, name=name, limit=settings.limit
        )
        rows = [
            [f"{count:,} points" if count else "none", f"{seen:.0f}", f"{kept:.1%}", f"{s:.1f}"]
            for count, (seen, kept, s) in zip(FEW, found, strict=True)
        ]
        print(f"{table([f'{name}: {header[0]}', *header[1:]], rows)}\n", flush=True)


def print_foliage(settings: Settings) -> None:
    """What finer windows, more views and smaller steps do on leaves."""
    _print_against_points(settings, ("treehill",), tuple(FOLIAGE))


def _print_against_points(settings: Settings, names: Sequence[str], arms: Sequence[str]) -> None:
    find_scenes()
    header = ["kept", "points known", "within 1%", "within 5%", "CPU s"]
    arguments = {"limit": settings.limit // 2}
    _print_arms("benchmarks.stereo.points:score_points", PointScore, names, arms, header, arguments)


def print_bare(settings: Settings) -> None:
    """The scenes with their points, without, and with depth maps instead."""
    names = [name for name in at_hand(settings.scenes) if name != "made, no texture"]
    prepare(names, settings.cache)
    arguments = {"names": names, "cache": str(settings.cache), "limit": settings.limit}
    for_each = {"SfM's points": "", "no points": "depths", "depth maps": "points"}
    scores_of_start = {
        label: scores_of(
            ARMS["stereo"], "benchmarks.stereo.truth:score_all", without=without, **arguments
        )
        for label, without in for_each.items()
    }
    header = ["begun from", "kept", "within 1%", "within 5%", "reached", "CPU s"]
    for name in names:
        rows = [
            [label, *Score(**scores[name]).cells()] for label, scores in scores_of_start.items()
        ]
        print(f"{table([f'{name}: {header[0]}', *header[1:]], rows)}\n", flush=True)


def print_dense(settings: Settings) -> None:
    """Seeds of a budget against true depth, beside sparse ones."""
    names = [name for name in at_hand(settings.scenes) if name != "made, no texture"]
    prepare(names, settings.cache)
    header = ["photographs, depths", "seeds", "within 1%", "within 5%", "CPU s"]
    for name in names:
        rows = call(
            "benchmarks.stereo.dense:score_dense", threads=THREADS, name=name,
            cache=str(settings.cache), limit=settings.limit,
        )  # fmt: skip
        cells = [
            [row["label"], row["size"], f"{row['seeds']:,}",
             *(f"{share:.1%}" for share in row["shares"]), f"{row['seconds']:.1f}"]
            for row in rows
        ]  # fmt: skip
        print(f"{table([name, *header], cells)}\n", flush=True)


def _print_arms(
    function: str,
    score: Callable[..., Any],
    names: Sequence[str],
    arms: Sequence[str],
    header: Sequence[str],
    arguments: dict[str, Any],
) -> None:
    """A table a scene, a row an arm."""
    scores_of_arm = {
        arm: scores_of({**ARMS, **FOLIAGE}[arm], function, names=list(names), **arguments)
        for arm in arms
    }
    for name in names:
        rows = [[arm, *score(**scores[name]).cells()] for arm, scores in scores_of_arm.items()]
        print(f"{table([name, *header], rows)}\n", flush=True)


PRINTERS: dict[str, Callable[[Settings], None]] = {
    "speed": print_speed,
    "whole": print_whole,
    "truth": print_truth,
    "pairs": print_pairs,
    "points": print_points,
    "few": print_few,
    "bare": print_bare,
    "foliage": print_foliage,
    "dense": print_dense,
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
