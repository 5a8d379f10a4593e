"""When do seeds help? The ledger of ``seeding.py``, as gains by budget, steps and photographs.

``auto`` and the other methods over SfM's points; strategies over 3DGS's densification from SfM's
points; seeds over points of the same photographs alone, and over the random start; and what
`splatseed info`'s advice is worth, with its threshold chosen on the other captures. Prints
Markdown.
"""

from __future__ import annotations

import csv
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import tyro
from benchmarks.common.markdown import table
from benchmarks.training.baseline import read_ledger

from splatseed.errors import SplatseedError
from splatseed.seeding.advice import AS_IT_IS, MIN_ROOM, Measured, advise
from splatseed.training.settings import SEED_SHARE

__all__: list[str] = []

SFM, RANDOM, NO_POINTS = "sfm", "random as gsplat", "auto, no points"
PLAN = ("rho", "steps", "photographs")
FACTS = ("psnr", "ssim", "gaussians", "seeds", "cap", "points")
ROOMS = (1.0, 1.1, 1.3, 1.5, 2.0, 3.0, 4.0, inf)
"""Thresholds of the advice that are compared; above the last, nothing is ever added."""


class Plan(NamedTuple):
    """What a run has beside its capture, seeds and strategy."""

    rho: float
    steps: int
    every: int

    def __str__(self) -> str:
        views = "all" if self.every == 1 else f"1 in {self.every}"
        return f"{self.rho:g} | {self.steps:,} | {views}"


@dataclass(frozen=True)
class Ledger:
    """Runs by (capture, arm, strategy, plan), a list over seeds each."""

    runs: Mapping[tuple[str, str, str, Plan], Mapping[int, Mapping[str, Any]]]

    @property
    def plans(self) -> list[Plan]:
        """All plans."""
        return sorted({plan for *_, plan in self.runs})

    def gains(
        self, plan: Plan, arm: tuple[str, str], over: tuple[str, str]
    ) -> dict[str, tuple[float, float]]:
        """PSNR and SSIM gained by capture, by seeds that both have; arms are (seeds, strategy)."""
        found = {}
        for capture in dict.fromkeys(key[0] for key in self.runs):
            ours = self.runs.get((capture, *arm, plan), {})
            theirs = self.runs.get((capture, *over, plan), {})
            if common := ours.keys() & theirs.keys():
                found[capture] = tuple(
                    statistics.mean(ours[seed][name] - theirs[seed][name] for seed in common)
                    for name in ("psnr", "ssim")
                )
        return found


def read(path: Path) -> Ledger:
    """The ledger that ``seeding.py`` has written."""
    runs: dict[Any, dict[int, Mapping[str, Any]]] = {}
    for (capture, arm, strategy, rho, steps, _, seed, every), run in read_ledger(path).items():
        runs.setdefault((capture, arm, strategy, Plan(rho, steps, every)), {})[seed] = run
    return Ledger(runs)


def cell(gains: Mapping[str, tuple[float, float]]) -> str:
    """Mean and standard error over captures, thousandths of SSIM, and the worst capture."""
    if not gains:
        return ""
    psnr, ssim = zip(*gains.values(), strict=True)
    error = f" ± {statistics.stdev(psnr) / len(psnr) ** 0.5:.2f}" if len(psnr) > 1 else ""
    worst = min(gains, key=lambda capture: gains[capture][0])
    mean = f"{statistics.mean(psnr):+.2f}{error} / {1000 * statistics.mean(ssim):+.0f}"
    return f"{mean}; {worst} {gains[worst][0]:+.2f} ({len(psnr)})"


def compared(
    ledger: Ledger, title: str, arms: Mapping[str, tuple[tuple[str, str], tuple[str, str]]]
) -> None:
    """Print a row for each plan, a column for each arm over its baseline; but no empty ones."""
    cells = {
        (plan, name): cell(ledger.gains(plan, *pair))
        for plan in ledger.plans
        for name, pair in arms.items()
    }
    plans = [plan for plan in ledger.plans if any(cells[plan, name] for name in arms)]
    names = [name for name in arms if any(cells[plan, name] for plan in plans)]
    rows = [[*str(plan).split(" | "), *(cells[plan, name] for name in names)] for plan in plans]
    if not names:
        return
    print(f"### {title}\n\n{table([*PLAN, *names], rows)}\n")


def advice(ledger: Ledger, strategy: str) -> Iterable[list[str]]:
    """By plan: gains of the advice over SfM's points, its threshold from the other captures."""
    by_plan = {p: ledger.gains(p, ("auto", strategy), (SFM, strategy)) for p in ledger.plans}
    rooms = {
        (plan, capture): _room(ledger, capture, strategy, plan)
        for plan, gains in by_plan.items()
        for capture in gains
    }

    def followed(plan: Plan, capture: str, room: float) -> float:
        """What following the advice gains."""
        has = rooms[plan, capture]
        said = advise(Measured(1000, 0.0), round(1000 * has), strategy=strategy, room=room)
        return 0.0 if said.method == AS_IT_IS else by_plan[plan][capture][0]

    def chosen(capture: str) -> float:
        """The threshold with the best sum over the other captures; in doubt the one in use."""
        others = [(p, c) for p, gains in by_plan.items() for c in gains if c != capture]
        return max(
            ROOMS,
            key=lambda room: (
                round(sum(followed(*each, room) for each in others), 6),
                room == MIN_ROOM,
            ),
        )

    for plan, gains in by_plan.items():
        if gains:
            left_out = [followed(plan, capture, chosen(capture)) for capture in gains]
            in_use = [followed(plan, capture, MIN_ROOM) for capture in gains]
            always = [each[0] for each in gains.values()]
            means = (f"{statistics.mean(each):+.2f}" for each in (left_out, in_use, always))
            yield [strategy, *str(plan).split(" | "), *means, f"{len(gains)}"]


def _room(ledger: Ledger, capture: str, strategy: str, plan: Plan) -> float:
    """The number of seeds with which training can begin, per point of the capture."""
    run = next(iter(ledger.runs[capture, SFM, strategy, plan].values()))
    return float(run["cap"] * SEED_SHARE.get(strategy, 1.0) / run["points"])


@dataclass(frozen=True)
class Settings:
    """What to read."""

    ledger: Path = Path("seeding.jsonl")
    """The ledger of ``benchmarks.training.seeding``."""
    csv: Path | None = None
    """Where to write the runs as CSV."""


def main(settings: Settings) -> None:
    """Print the tables."""
    ledger = read(settings.ledger)
    if settings.csv is not None:
        write_csv(settings.csv, ledger)
    over_sfm = {each: (("auto", each), (SFM, each)) for each in ("none", "default", "mcmc", "grow")}
    compared(ledger, "auto over SfM's points", over_sfm)
    methods = [(m, s) for s in ("none", "default") for m in ("mls", "cover", "stereo")]
    others = {f"{m}, {s}": ((m, s), (SFM, s)) for m, s in methods}
    compared(ledger, "Other methods over SfM's points", others)
    strategies = {s: ((SFM, s), (SFM, "default")) for s in ("none", "mcmc", "grow")}
    compared(ledger, "Strategies over default, from SfM's points", strategies)
    few = {"auto adds to them, default": ("auto, refined", "default")}
    few |= {"auto without them, grow": (NO_POINTS, "grow")}
    base = ("triangulated", "default")
    title = "Over points triangulated from the same photographs, with default"
    compared(ledger, title, {name: (arm, base) for name, arm in few.items()})
    absent = {f"auto, {s}": ((NO_POINTS, s), (RANDOM, "default")) for s in ("default", "grow")}
    absent["auto, grow, over SfM's points, grow"] = ((NO_POINTS, "grow"), (SFM, "grow"))
    compared(ledger, "Without points, over the random start with default", absent)
    print("### The advice over SfM's points\n")
    header = ["threshold from the others", "in use", "always auto", "captures"]
    rows = [row for each in ("default", "mcmc") for row in advice(ledger, each)]
    print(table(["strategy", *PLAN, *header], rows))


def write_csv(path: Path, ledger: Ledger) -> None:
    """Write a line for each run."""
    with path.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(["capture", "arm", "strategy", *Plan._fields, "seed", *FACTS])
        for (*words, plan), runs in sorted(ledger.runs.items()):
            for seed, run in sorted(runs.items()):
                lines.writerow([*words, *plan, seed, *(round(run[name], 4) for name in FACTS)])


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
