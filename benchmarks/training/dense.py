"""What dense seeds are worth: the ledger of ``seeding.py``, as gains and as seconds to a quality.

Each arm (seeds and strategy) is compared with a baseline on the same held-out views, at the same
cap on Gaussians: the quality it ends with, and the CPU seconds, seeds included, after which it
first has the quality that the baseline ends with. *Chosen on the others* is what the arm would gain
that has the highest mean over the other captures. Prints Markdown.
"""

from __future__ import annotations

import csv
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import tyro
from benchmarks.common.markdown import table
from benchmarks.training.baseline import read_ledger

from splatseed.errors import ParameterError, SplatseedError

__all__: list[str] = []

FACTS = ("psnr", "ssim", "gaussians", "seeds", "cap", "points", "whole_processor")
CURVE = ("step", "seconds", "psnr", "ssim")


class Arm(NamedTuple):
    """What seeds, and which strategy."""

    seeds: str
    strategy: str

    def __str__(self) -> str:
        return f"{self.seeds} + {self.strategy}"


class Plan(NamedTuple):
    """What runs have in common that are compared."""

    rho: float
    steps: int


@dataclass(frozen=True)
class Settings:
    """What to read."""

    ledger: Path = Path("dense.jsonl")
    """The ledger of ``benchmarks.training.seeding``."""
    baseline: tuple[str, str] = ("sfm", "grow")
    """Seeds and strategy to compare with."""
    csv: Path | None = None
    """Where to write the runs as CSV, and their curves beside it as NAME_curves.csv."""


Runs = Mapping[tuple[Plan, Arm], Mapping[tuple[str, int, int], Mapping[str, Any]]]
"""By plan and arm, then by capture, data factor and seed."""


def read_runs(path: Path) -> Runs:
    """Read the runs of a ledger that kept their curves."""
    runs: dict[tuple[Plan, Arm], dict[tuple[str, int, int], Mapping[str, Any]]] = {}
    for (capture, seeds, strategy, rho, steps, factor, seed, _), run in read_ledger(path).items():
        if "curve" in run:
            key = Plan(rho, steps), Arm(seeds, strategy)
            runs.setdefault(key, {})[capture, factor, seed] = run
    return runs


def seconds_to(run: Mapping[str, Any], column: str, quality: float) -> float | None:
    """Return the CPU seconds after which a run's curve reaches a quality; None if it does not.

    Linear between the points of the curve.
    """
    at, before = CURVE.index(column), None
    for point in run["curve"]:
        if point[at] >= quality:
            if before is None:
                return float(point[1])
            share = (quality - before[at]) / (point[at] - before[at])
            return float(before[1] + share * (point[1] - before[1]))
        before = point
    return None


@dataclass(frozen=True)
class Comparison:
    """An arm and the baseline on one capture, over the seeds that both have."""

    psnr: float  # gain, dB
    ssim: float
    seconds: float  # of the whole run, as a fraction of the baseline's
    reached: Mapping[str, float | None]  # seconds to its quality likewise, by psnr and ssim


def compare(ours: Runs, arm: Arm, baseline: Arm, plan: Plan) -> dict[str, Comparison]:
    """Compare an arm with the baseline on each capture that both have run on, at equal sizes."""
    runs, theirs = ours.get((plan, arm), {}), ours.get((plan, baseline), {})
    found: dict[str, list[Comparison]] = {}
    for key in sorted(runs.keys() & theirs.keys()):
        run, base = runs[key], theirs[key]
        whole, last = base["whole_processor"], dict(zip(CURVE, base["curve"][-1], strict=True))
        times = {name: seconds_to(run, name, last[name]) for name in ("psnr", "ssim")}
        reached = {name: None if each is None else each / whole for name, each in times.items()}
        gains = run["psnr"] - base["psnr"], run["ssim"] - base["ssim"]
        each = Comparison(*gains, run["whole_processor"] / whole, reached)
        found.setdefault(key[0], []).append(each)
    return {capture: _mean(each) for capture, each in found.items()}


def _mean(seeds: list[Comparison]) -> Comparison:
    """Average over runs; a quality counts as reached if all runs reach it."""
    reached: dict[str, float | None] = {}
    for name in seeds[0].reached:
        times = [each.reached[name] for each in seeds]
        known = [each for each in times if each is not None]
        reached[name] = statistics.mean(known) if len(known) == len(times) else None
    psnr, ssim, seconds = (
        statistics.mean(getattr(each, name) for each in seeds)
        for name in ("psnr", "ssim", "seconds")
    )
    return Comparison(psnr, ssim, seconds, reached)


def rows(runs: Runs, baseline: Arm) -> Iterable[list[str]]:
    """Yield a row per plan and arm: gains, whole seconds, and seconds to the baseline's quality."""
    for plan, arm in sorted(runs):
        found = compare(runs, arm, baseline, plan)
        if found and arm != baseline:
            yield [f"{plan.rho:g}", f"{plan.steps:,}", str(arm), *_cells(found)]


def _cells(found: Mapping[str, Comparison]) -> list[str]:
    gains = {capture: each.psnr for capture, each in found.items()}
    spread = statistics.stdev(gains.values()) / len(gains) ** 0.5 if len(gains) > 1 else 0.0
    error = f" ± {spread:.2f}" if len(gains) > 1 else ""
    worst = min(gains, key=lambda capture: gains[capture])
    ssim = statistics.mean(each.ssim for each in found.values())
    seconds = statistics.mean(each.seconds for each in found.values())
    times = []
    for name in ("psnr", "ssim"):
        known = [each.reached[name] for each in found.values() if each.reached[name] is not None]
        mean = f"{statistics.mean(known):.2f} " if known else ""  # type: ignore[type-var]
        times.append(f"{mean}({len(known)} of {len(found)})")
    return [
        f"{statistics.mean(gains.values()):+.2f}{error}",
        f"{1000 * ssim:+.0f}",
        f"{worst} {gains[worst]:+.2f}",
        f"{seconds:.2f}",
        *times,
    ]


def left_out(runs: Runs, baseline: Arm, plan: Plan) -> dict[str, tuple[Arm, float]]:
    """For each capture, the arm that gains most on the others, and its gain here.

    Only arms that have run on all captures of the plan's baseline; the baseline is one of them.
    """
    captures = {capture for capture, *_ in runs.get((plan, baseline), {})}
    gains = {
        arm: {capture: each.psnr for capture, each in compare(runs, arm, baseline, plan).items()}
        for of, arm in runs
        if of == plan
    }
    gains = {arm: each for arm, each in gains.items() if each.keys() == captures}
    chosen = {}
    for capture in sorted(captures) if len(captures) > 1 else ():
        others = captures - {capture}
        best = max(gains, key=lambda arm: (sum(gains[arm][c] for c in others), arm == baseline))
        chosen[capture] = best, gains[best][capture]
    return chosen


def left_out_rows(runs: Runs, baseline: Arm) -> Iterable[list[str]]:
    """Yield a row per plan: what the arm chosen on the other captures gains."""
    for plan in sorted({plan for plan, _ in runs}):
        chosen = left_out(runs, baseline, plan)
        if chosen:
            gains = {capture: gain for capture, (_, gain) in chosen.items()}
            worst = min(gains, key=lambda capture: gains[capture])
            arms = sorted({str(arm) for arm, _ in chosen.values()})
            mean = f"{statistics.mean(gains.values()):+.2f}"
            yield [f"{plan.rho:g}", f"{plan.steps:,}", "; ".join(arms), mean,
                   f"{worst} {gains[worst]:+.2f}"]  # fmt: skip


def write_csv(path: Path, runs: Runs) -> None:
    """Write a line for each run, and a line for each point of its curve."""
    curves = path.with_name(f"{path.stem}_curves.csv")
    names = ["capture", "method", "strategy", "rho", "steps", "factor", "seed"]
    with (
        path.open("w", encoding="utf-8", newline="") as file,
        curves.open("w", encoding="utf-8", newline="") as curve,
    ):
        lines, points = (csv.writer(each, lineterminator="\n") for each in (file, curve))
        lines.writerow([*names, *FACTS])
        points.writerow([*names, *(name if name != "step" else "at" for name in CURVE)])
        for (plan, arm), by_capture in sorted(runs.items()):
            for (capture, factor, seed), run in sorted(by_capture.items()):
                key = [capture, *arm, *plan, factor, seed]
                lines.writerow([*key, *(round(run[name], 4) for name in FACTS)])
                points.writerows([*key, *point] for point in run["curve"])


def main(settings: Settings) -> None:
    """Print the tables."""
    runs, baseline = read_runs(settings.ledger), Arm(*settings.baseline)
    if not runs:
        raise ParameterError(
            "a ledger of benchmarks.training.seeding", found=f"no runs in {settings.ledger}",
            fix="Pass --ledger FILE.",
        )  # fmt: skip
    if settings.csv is not None:
        write_csv(settings.csv, runs)
    plan = ["rho", "steps"]
    header = ["dB", "SSIM / 1000", "worst", "seconds", "to its PSNR", "to its SSIM"]
    print(f"### Over {baseline}\n\n{table([*plan, 'arm', *header], rows(runs, baseline))}\n")
    header = ["chosen on the others", "dB", "worst"]
    print(f"### Left out\n\n{table([*plan, *header], left_out_rows(runs, baseline))}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
