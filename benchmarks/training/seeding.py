"""What seeds and strategies gain on held-out training views, at equal numbers of Gaussians.

The test views (names sorted, every 8th) are taken out of a capture first; of the rest every 8th is
held out and scored, another eighth with each seed. Each run has its own process; runs in the ledger
are not repeated. Gains are over the first arm under the first strategy. Prints Markdown; see
README.md.
"""

from __future__ import annotations

import os
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro
from benchmarks.common.children import call
from benchmarks.common.clouds import find_scenes
from benchmarks.common.ledger import read_ledger, report, run_missing, write_line
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.training.seeding_arms import ARMS

from splatseed.errors import SplatseedError

__all__: list[str] = []

CAPTURES = ("dorm", "desk", "stone_horse", "face", "fern", "fox", "treehill", "bonsai")
Key = tuple[str, str, str, float, int, int, int, int]
"""Capture, arm, strategy, rho, steps, data factor, seed, and ``every``."""


@dataclass(frozen=True)
class Settings:
    """What to run."""

    scenes: tuple[str, ...] = CAPTURES
    """Captures, by their names in the folder of captures."""
    arms: tuple[str, ...] = tuple(ARMS)
    """Which seeds."""
    strategies: tuple[str, ...] = ("default", "none")
    """Densification."""
    rho: tuple[float, ...] = (0.25,)
    """Most Gaussians, per pixel of a photograph at the size that is trained."""
    max_steps: int = 1500
    """Training steps."""
    seeds: int = 1
    """Runs of each arm on each capture, with seeds 0, 1, ..."""
    data_factor: int = 2
    """By how much photographs are made smaller."""
    every: int = 1
    """Train on every n-th of the training photographs, by name."""
    jobs: int = os.cpu_count() or 1
    """Runs at a time, on one thread each."""
    backend: Literal["cpu", "cuda"] = "cpu"
    """Where to train; runs on a GPU want a ledger of their own."""
    ledger: Path = Path("seeding.jsonl")
    """Where results are kept, a line a run; seeds in a folder of the same name beside it."""


def run(key: Key, scenes: Path, ledger: Path, backend: str) -> None:
    """One run, and its line in the ledger."""
    scene, arm, strategy, rho, max_steps, data_factor, seed, every = key
    report(f"{scene}, {arm}, {strategy}, rho {rho:g}, seed {seed} ...")
    result = call(
        "benchmarks.training.seeding_arms:train", threads=1, scene=str(scenes / scene), arm=arm,
        strategy=strategy, rho=rho, max_steps=max_steps, data_factor=data_factor, seed=seed,
        every=every, kept=str(ledger.resolve().with_suffix(".seeds")), backend=backend,
    )  # fmt: skip
    write_line(ledger, key, result)
    report(f"  {scene}, {arm}, {strategy}: {result['psnr']:.2f} dB")


def wanted(settings: Settings) -> Iterable[Key]:
    """All runs that are asked for: each arm of each capture once before any is repeated."""
    for seed in range(settings.seeds):
        for rho in settings.rho:
            for strategy in settings.strategies:
                for arm in settings.arms:
                    for scene in settings.scenes:
                        steps, factor = settings.max_steps, settings.data_factor
                        yield scene, arm, strategy, rho, steps, factor, seed, settings.every


def rows(results: Mapping[Any, Mapping[str, Any]], settings: Settings) -> Iterable[list[str]]:
    """By strategy, rho and arm: PSNR / SSIM (Gaussians, seeds) per capture, the mean, the gain."""
    baseline = settings.arms[0], settings.strategies[0]
    for strategy in settings.strategies:
        for rho in settings.rho:
            base = [_means(results, (s, *baseline, rho), settings) for s in settings.scenes]
            for arm in settings.arms:
                means = [
                    _means(results, (s, arm, strategy, rho), settings) for s in settings.scenes
                ]
                if any(means):
                    known = [each for each in means if each]
                    mean = [statistics.mean(v) for v in zip(*known, strict=True)]
                    score = _scores(mean) if len(known) == len(means) else ""
                    gain = "" if (arm, strategy) == baseline else _gain(means, base)
                    yield [strategy, f"{rho:g}", arm, *(map(_cell, means)), score, gain]


def _gain(means: list[list[float]], base: list[list[float]]) -> str:
    """Mean gain in PSNR with its standard error over captures, and in SSIM."""
    pairs = [(ours, theirs) for ours, theirs in zip(means, base, strict=True) if ours and theirs]
    if not pairs:
        return ""
    psnr, ssim = ([ours[i] - theirs[i] for ours, theirs in pairs] for i in (0, 1))
    error = f" ± {statistics.stdev(psnr) / len(psnr) ** 0.5:.2f}" if len(psnr) > 1 else ""
    return f"{statistics.mean(psnr):+.2f}{error} / {statistics.mean(ssim):+.3f}"


def _means(
    results: Mapping[Any, Mapping[str, Any]], arm: tuple[str, str, str, float], settings: Settings
) -> list[float]:
    """The means over the seeds; empty until all have been run."""
    rest = (settings.max_steps, settings.data_factor)
    runs = [results.get((*arm, *rest, seed, settings.every)) for seed in range(settings.seeds)]
    names = ("psnr", "ssim", "gaussians", "seeds", "seeding", "seconds")
    known = [each for each in runs if each]
    if len(known) < len(runs):
        return []
    return [statistics.mean(each[name] for each in known) for name in names]


def _cell(means: list[float]) -> str:
    if not means:
        return ""
    _, _, count, seeds, seeding, seconds = means
    numbers = f"{count / 1000:.1f}k, {seeds / 1000:.1f}k seeds"
    return f"{_scores(means)} ({numbers}, {seeding:.0f} + {seconds:.0f} s)"


def _scores(means: list[float]) -> str:
    return f"{means[0]:.2f} / {means[1]:.4f}"


def main(settings: Settings) -> None:
    """Run what is not there yet, and print the table."""
    train = partial(run, scenes=find_scenes(), ledger=settings.ledger, backend=settings.backend)
    run_missing(wanted(settings), train, settings.ledger, settings.jobs)
    header = ["strategy", "rho", "seeds", *settings.scenes, "mean", "gain, dB / SSIM"]
    print(f"{describe()}\n\n### {settings.max_steps:,} steps, {settings.seeds} run(s) of each\n")
    print(table(header, rows(read_ledger(settings.ledger), settings)))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
