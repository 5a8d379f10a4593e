"""When do seeds help? The ledger of ``seeding.py``, as gains by budget, steps and photographs.

``auto`` and the other methods over SfM's points; strategies over 3DGS's densification from SfM's
points; seeds over points of the same photographs alone, and over the random start; and what
`splatseed info`'s advice is worth, with its threshold chosen on the other captures. Prints
Markdown.
"""

from __future__ import annotations

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
from splatseed.seeding.advice import AS_IT_IS, ROOM, Measured, advise
from splatseed.train.seeds import SEEDS_SHARE

__all__: list[str] = []

SFM, RANDOM, NO_POINTS = "sfm", "random as gsplat", "auto, no points"
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
        """All plans, the one with most runs first."""
        counts: dict[Plan, int] = {}
        for *_, plan in self.runs:
            counts[plan] = counts.get(plan, 0) + 1
        return sorted(counts, key=lambda plan: (-counts[plan], plan))

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
    ledger: Ledger, arms: Iterable[tuple[tuple[str, str], tuple[str, str]]]
) -> Iterable[list[str]]:
    """A row for each plan, a cell for each arm over its baseline; empty rows are left out."""
    arms = list(arms)
    for plan in ledger.plans:
        cells = [cell(ledger.gains(plan, arm, over)) for arm, over in arms]
        if any(cells):
            yield [*str(plan).split(" | "), *cells]


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
                room == ROOM,
            ),
        )

    for plan, gains in by_plan.items():
        if gains:
            left_out = [followed(plan, capture, chosen(capture)) for capture in gains]
            in_use = [followed(plan, capture, ROOM) for capture in gains]
            always = [each[0] for each in gains.values()]
            means = (f"{statistics.mean(each):+.2f}" for each in (left_out, in_use, always))
            yield [strategy, *str(plan).split(" | "), *means, f"{len(gains)}"]


def _room(ledger: Ledger, capture: str, strategy: str, plan: Plan) -> float:
    """The number of seeds with which training can begin, per point of the capture."""
    run = next(iter(ledger.runs[capture, SFM, strategy, plan].values()))
    return float(run["cap"] * SEEDS_SHARE.get(strategy, 1.0) / run["points"])


@dataclass(frozen=True)
class Settings:
    """What to read."""

    ledger: Path = Path("seeding.jsonl")
    """The ledger of ``benchmarks.training.seeding``."""


def main(settings: Settings) -> None:
    """Print the tables."""
    ledger = read(settings.ledger)
    plan = ["rho", "steps", "photographs"]
    strategies = ("none", "default", "mcmc", "grow")
    print("### auto over SfM's points\n")
    pairs = [(("auto", each), (SFM, each)) for each in strategies]
    print(table([*plan, *strategies], compared(ledger, pairs)))
    print("\n### Other methods over SfM's points\n")
    methods = [(m, s) for s in ("none", "default") for m in ("mls", "cover", "stereo")]
    pairs = [((m, s), (SFM, s)) for m, s in methods]
    print(table([*plan, *(f"{m}, {s}" for m, s in methods)], compared(ledger, pairs)))
    print("\n### Strategies over default, from SfM's points\n")
    pairs = [((SFM, each), (SFM, "default")) for each in ("none", "mcmc", "grow")]
    print(table([*plan, "none", "mcmc", "grow"], compared(ledger, pairs)))
    print("\n### Over points triangulated from the same photographs, with default\n")
    base = ("triangulated", "default")
    pairs = [((arm, s), base) for arm, s in (("auto, refined", "default"), (NO_POINTS, "grow"))]
    header = ["auto adds to them, default", "auto without them, grow"]
    print(table([*plan, *header], compared(ledger, pairs)))
    print("\n### Without points, over the random start with default\n")
    pairs = [((NO_POINTS, each), (RANDOM, "default")) for each in ("default", "grow")]
    pairs += [((NO_POINTS, "grow"), (SFM, "grow"))]
    header = ["auto, default", "auto, grow", "auto, grow, over SfM's points, grow"]
    print(table([*plan, *header], compared(ledger, pairs)))
    print("\n### The advice over SfM's points\n")
    header = ["threshold from the others", "in use", "always auto", "captures"]
    rows = [row for each in ("default", "mcmc") for row in advice(ledger, each)]
    print(table(["strategy", *plan, *header], rows))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
