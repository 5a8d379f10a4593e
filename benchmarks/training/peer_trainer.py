"""Our trainer beside gsplat's own (examples/simple_trainer.py of version 1.5.3), on the CPU.

Both train on the same photographs, cameras, points, steps and cap, through the same rasteriser, and
are scored by the same function; what differs is the trainer: its loop, learning rates, schedules,
losses, densification and normalisation of the world. Each run has a process of its own. Prints
Markdown; says on stderr how far it is. See README.md.
"""

from __future__ import annotations

import os
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import torch
import tyro
from benchmarks.common.children import call
from benchmarks.common.clouds import REAL_SCENES, find_scenes
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.training.peer_runs import Split, read_scene
from benchmarks.training.peer_stand_ins import check_examples

from splatseed.errors import ParameterError, SplatseedError
from splatseed.photos.loading import load_split
from splatseed.training import TrainSettings
from splatseed.training.settings import BUDGET, StrategyName

__all__: list[str] = []

STRATEGIES = ("default", "grow", "mcmc")
PEER = {f"gsplat-{strategy}": strategy for strategy in STRATEGIES}
OURS = {
    f"splatseed-{name}": name
    for name in get_args(StrategyName)
    if name.partition("-")[0] in STRATEGIES
}
"""The same strategies, in splatseed's conventions and in 3DGS's."""
ARMS = tuple(sorted((*PEER, *OURS), key=lambda name: name.split("-")[1:]))


@dataclass(frozen=True)
class Settings:
    """What to compare."""

    scene: Path
    """A capture's folder, or the name of one in the folder of captures."""
    gsplat_examples: Path | None = None
    """The folder examples of a checkout of gsplat v1.5.3."""
    data_factor: int = 1
    """By how much photographs are made smaller."""
    max_steps: int = 7000
    """Training steps; both trainers shrink their schedules from 30,000."""
    cap_max: int | None = None
    """Most Gaussians of strategies mcmc and grow (default: 1,000,000)."""
    cap_default: bool = False
    """Hold strategy default to --cap-max as well, by our rule in both trainers."""
    repeats: int = 1
    """Runs of each arm, with seeds 0, 1, ..."""
    arms: tuple[str, ...] = ARMS
    """Which; without these, all."""
    split: Split = "validation"
    """Score on every eighth training view, test views taken out first; or on the test views."""
    threads: int = os.cpu_count() or 1
    """Threads of each run."""

    def __post_init__(self) -> None:
        unknown = ", ".join(arm for arm in self.arms if arm not in ARMS)
        known = bool(self.arms) and not unknown
        self._require(known, f"--arms of {', '.join(ARMS)}", unknown or "none")
        for name in ("repeats", "threads"):
            self._require(getattr(self, name) > 0, f"--{name} of 1 or more", getattr(self, name))
        capped = self.cap_max is not None or not self.cap_default
        self._require(capped, "--cap-max with --cap-default", "none")
        TrainSettings(max_steps=self.max_steps, data_factor=self.data_factor, cap_max=self.cap_max)

    @staticmethod
    def _require(fits: bool, expected: str, found: object) -> None:
        if not fits:
            raise ParameterError(expected, found=f"{found}", fix="See --help.")


def run_arm(arm: str, seed: int, scene: Path, settings: Settings) -> dict[str, float]:
    """One run, in a process of its own."""
    common: dict[str, Any] = {"scene": str(scene), "split": settings.split}
    common["settings"] = train_settings(arm, seed, settings)
    if arm in OURS:
        return call("benchmarks.training.peer_runs:train_ours", threads=settings.threads, **common)
    return call(
        "benchmarks.training.peer_runs:train_peer", threads=settings.threads, **common,
        examples=str(settings.gsplat_examples), capped=settings.cap_default,
    )  # fmt: skip


def train_settings(arm: str, seed: int, settings: Settings) -> dict[str, Any]:
    """Fields of ``TrainSettings`` for a run of either trainer."""
    strategy = OURS.get(arm) or PEER[arm]
    capped = not strategy.startswith("default") or settings.cap_default
    return {
        "strategy": strategy,
        "max_steps": settings.max_steps,
        "data_factor": settings.data_factor,
        "cap_max": settings.cap_max if capped else None,
        "seed": seed,
    }


def compare(scene: Path, settings: Settings) -> dict[str, list[dict[str, float]]]:
    """All runs, arm by arm within each seed, so that a slow hour of the machine is shared."""
    results: dict[str, list[dict[str, float]]] = {}
    for seed in range(settings.repeats):
        for arm in settings.arms:
            _say(f"{arm}, seed {seed}: {settings.max_steps:,} steps ...")
            try:
                result = run_arm(arm, seed, scene, settings)
            except SplatseedError as error:  # the others may have taken hours
                print(f"SKIPPED {arm}, seed {seed}: {error}\n")
                continue
            _say("  " + ", ".join(f"{name} {value:g}" for name, value in result.items()))
            results.setdefault(arm, []).append(result)
    return results


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def rows(results: Mapping[str, Sequence[Mapping[str, float]]]) -> Iterable[list[str]]:
    """An arm each: means over the seeds, and their standard deviation where there are several."""
    for arm, runs in results.items():
        trainer, _, strategy = arm.partition("-")
        columns = {name: [run[name] for run in runs] for name in runs[0]}
        yield [
            trainer,
            strategy,
            spread(columns["psnr"], ".2f"),
            spread(columns["ssim"], ".4f"),
            f"{statistics.mean(columns['gaussians']):,.0f}",
            f"{statistics.mean(columns['seconds']):,.0f}",
        ]


def spread(values: Sequence[float], form: str) -> str:
    """Mean, and ± the standard deviation of several."""
    mean = f"{statistics.mean(values):{form}}"
    return f"{mean} ± {statistics.stdev(values):{form}}" if len(values) > 1 else mean


def heading(path: Path, settings: Settings) -> str:
    """What is compared; the views are read for it, so that what cannot be read is said at once.

    Raises:
        InputError: The capture cannot be trained on.
    """
    scene = read_scene(path, settings.split)
    train, test_views = load_split(scene, data_factor=settings.data_factor)
    cap = f"{settings.cap_max or BUDGET:,}{'' if settings.cap_default else ' for mcmc and grow'}"
    return (
        f"### Peer: gsplat's trainer, {path.name}, {settings.max_steps:,} steps\n\n"
        f"{len(train)} training and {len(test_views)} {settings.split} views of {train[0].width} x "
        f"{train[0].height}; {len(scene.points):,} points; cap {cap}; runs of an arm: "
        f"{settings.repeats}; threads: {settings.threads}.\n"
    )


def find_scene(named: Path) -> Path:
    """The capture's folder, by its path or by its name in the folder of captures."""
    if named.is_dir() or str(named) not in REAL_SCENES:
        return named  # that there is none is for the reader to say
    return find_scenes() / REAL_SCENES[str(named)]


def main(settings: Settings) -> None:
    """Compare and print."""
    if set(settings.arms) & set(PEER):
        check_examples(settings.gsplat_examples)
    path = find_scene(settings.scene).resolve()
    above = heading(path, settings)
    print(f"{describe()}, torch {torch.__version__}\n")
    warn_if_busy()
    results = compare(path, settings)
    header = ["trainer", "strategy", "PSNR, dB", "SSIM", "Gaussians at the end", "training, s"]
    print(f"{above}\n{table(header, rows(results))}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
