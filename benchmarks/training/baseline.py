"""What each choice of the training schedule gives, from SfM's points, on held-out training views.

The test views (names sorted, every 8th) are taken out of a capture first; of the rest every 8th is
held out and scored. An arm is a strategy, or one with a choice undone. Runs have a process of their
own each; those that are in the ledger are not run again. Prints Markdown; see README.md.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import tyro
from benchmarks.common.children import call
from benchmarks.common.clouds import find_scenes
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.training.baseline_arms import ARMS, CAPS, fingerprint

from splatseed.errors import ParameterError, SplatseedError

__all__ = ["read_ledger", "run_missing", "say", "write_line"]

WRITING = Lock()


@dataclass(frozen=True)
class Settings:
    """What to run."""

    scenes: tuple[str, ...] = tuple(CAPS)
    """Captures, by their names in the folder of captures."""
    arms: tuple[str, ...] = tuple(ARMS)
    """Which; without these, all."""
    max_steps: int = 1500
    """Training steps."""
    seeds: int = 2
    """Runs of each arm on each capture, with seeds 0, 1, ..."""
    data_factor: int = 2
    """By how much photographs are made smaller."""
    jobs: int = os.cpu_count() or 1
    """Runs at a time, on one thread each."""
    ledger: Path = Path("baseline.jsonl")
    """Where results are kept, a line a run."""

    def __post_init__(self) -> None:
        for name, given, known in (("scenes", self.scenes, CAPS), ("arms", self.arms, ARMS)):
            for each in given:
                if each not in known:
                    raise ParameterError(
                        f"--{name} of {', '.join(known)}", found=each, fix="Correct the name."
                    )


Key = tuple[str, str, int, int, int, str]
"""Capture, arm, steps, data factor, seed, and a fingerprint of the arm's numbers."""


def run(key: Key, scenes: Path, ledger: Path) -> None:
    """One run, and its line in the ledger."""
    scene, arm, max_steps, data_factor, seed, _ = key
    say(f"{scene}, {arm}, {max_steps:,} steps, seed {seed} ...")
    result = call(
        "benchmarks.training.baseline_arms:train", threads=1, scene=str(scenes / scene), arm=arm,
        max_steps=max_steps, data_factor=data_factor, seed=seed, cap_max=CAPS[scene],
    )  # fmt: skip
    write_line(ledger, key, result)
    say(f"  {scene}, {arm}: {result['psnr']:.2f} dB in {result['seconds']:.0f} s")


def write_line(ledger: Path, key: Sequence[Any], result: Mapping[str, Any]) -> None:
    """Add a result to a ledger, from any thread."""
    with WRITING, ledger.open("a", encoding="utf-8") as lines:
        lines.write(json.dumps([key, result]) + "\n")


def read_ledger(path: Path) -> dict[tuple[Any, ...], dict[str, Any]]:
    """The results so far; of runs that were made twice, the last."""
    if not path.is_file():
        return {}
    return {tuple(key): result for key, result in map(json.loads, path.open(encoding="utf-8"))}


def wanted(settings: Settings) -> Iterable[Key]:
    """All runs that are asked for: each arm of each capture once before any is repeated."""
    for seed in range(settings.seeds):
        for arm in settings.arms:
            for scene in settings.scenes:
                yield make_key(scene, arm, seed, settings)


def make_key(scene: str, arm: str, seed: int, settings: Settings) -> Key:
    """What a run is known by in the ledger."""
    steps = settings.max_steps
    return (scene, arm, steps, settings.data_factor, seed, fingerprint(scene, arm, steps))


def rows(results: Mapping[Key, Mapping[str, Any]], settings: Settings) -> Iterable[list[str]]:
    """An arm each: PSNR / SSIM by capture where all seeds have been run, and the mean of all."""
    for arm in settings.arms:
        means = [_means(results, arm, scene, settings) for scene in settings.scenes]
        known = [each for each in means if each]
        if known:
            whole = len(known) == len(means)
            mean = [statistics.mean(values) for values in zip(*known, strict=True)]
            yield [arm, *(_cell(each) for each in means), _cell(mean if whole else None)]


def _means(
    results: Mapping[Key, Mapping[str, Any]], arm: str, scene: str, settings: Settings
) -> list[float] | None:
    """PSNR, SSIM, Gaussians and seconds, averaged over the seeds; None until all have been run."""
    keys = [make_key(scene, arm, seed, settings) for seed in range(settings.seeds)]
    runs = [results[key] for key in keys if key in results]
    names = ("psnr", "ssim", "gaussians", "seconds")
    if len(runs) < settings.seeds:
        return None
    return [statistics.mean(run[name] for run in runs) for name in names]


def _cell(means: Sequence[float] | None) -> str:
    if means is None:
        return ""
    psnr, ssim, count, seconds = means
    return f"{psnr:.2f} / {ssim:.4f} ({count / 1000:.0f}k, {seconds:.0f} s)"


def say(text: str) -> None:
    """Tell how far it is, on stderr."""
    print(text, file=sys.stderr, flush=True)


def run_missing(wanted: Iterable[Any], run: Callable[..., None], ledger: Path, jobs: int) -> None:
    """Call ``run`` for the wanted keys that a ledger lacks, ``jobs`` at a time."""
    scenes, done = find_scenes(), read_ledger(ledger)
    missing = [key for key in wanted if key not in done]
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(partial(run, scenes=scenes, ledger=ledger), missing))


def main(settings: Settings) -> None:
    """Run what is not there yet, and print the table."""
    run_missing(wanted(settings), run, settings.ledger, settings.jobs)
    header = ["arm", *settings.scenes, "mean"]
    print(f"{describe()}\n\n### {settings.max_steps:,} steps, seeds: {settings.seeds}\n")
    print(table(header, rows(read_ledger(settings.ledger), settings)))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
