"""What the finished runs of some benchmarks gained, by the paper's methods and ratios.

Notation: a *way* is a strategy with a profile of the methods; ``gains`` of a way are a frame in dB,
a row for each (scene, ratio), a column for each method, NaN without a run. Of several sets of runs
that could not be compared, as those of two versions, a strategy's largest counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from splatseed.bench.comparisons import gains
from splatseed.bench.plan import ANY_RATIO, DEPTH, SFM, Arm
from splatseed.bench.runs import BenchRun, read_runs
from splatseed.bench.statistics import Difference
from splatseed.bench.study import Study, studies
from splatseed.methods import Profile, configure
from splatseed.training.settings import StrategyName

__all__ = ["LAYOUT", "RANDOM", "Results", "Way", "read_results"]

RANDOM = "random"
LAYOUT = ("linear", "triangle", "spline", "mls", "voronoi", "depth")
"""The methods in the order of the paper's tables."""


class Way(NamedTuple):
    """How seeds become Gaussians, and which parameters made the seeds."""

    strategy: StrategyName
    profile: Profile

    @property
    def label(self) -> str:
        """In a few words."""
        return f"{self.strategy}, profile {self.profile}"


@dataclass(frozen=True, eq=False)
class Results:
    """The runs of some benchmarks, planned or finished, and the studies of the finished ones."""

    runs: Sequence[BenchRun]
    found: Sequence[Study]

    def study(self, strategy: StrategyName) -> Study | None:
        """The largest set of a strategy's comparable runs; None if none has finished."""
        return next((each for each in self.found if strategy in each.strategies), None)

    @cached_property
    def arms(self) -> tuple[Arm, ...]:
        """All arms that are planned, each once."""
        return tuple(dict.fromkeys(run.spec.arm for run in self.runs))

    def ways(self) -> tuple[Way, ...]:
        """The ways of the paper's methods; first those of the paper itself."""
        known = (Way(a.strategy, a.profile) for a in self.arms if a.method in LAYOUT)
        own = dict.fromkeys(known)  # in the plans' order, where they are equally near to the paper
        return tuple(
            sorted(own, key=lambda w: (not w.strategy.endswith("-3dgs"), w.profile == "default"))
        )

    def scenes(self, *, with_depth: bool) -> tuple[str, ...]:
        """Scenes with or without runs of method depth, in the plans' order."""
        deep = {run.spec.scene.name for run in self.runs if run.spec.arm.method == DEPTH}
        names = dict.fromkeys(run.spec.scene.name for run in self.runs)
        return tuple(name for name in names if (name in deep) == with_depth)

    def ratios(self, scenes: Iterable[str]) -> tuple[float, ...]:
        """The ratios that are planned on some scenes."""
        names = set(scenes)
        known = {run.spec.arm.ratio for run in self.runs if run.spec.scene.name in names}
        return tuple(sorted(known - {1.0, ANY_RATIO}))

    def label(self, way: Way, method: str, ratio: float) -> str:
        """The label in a study of a way's arm; a method whose profiles are the same has one arm."""
        known = [a for a in self.arms if (a.method, a.ratio) == (method, ratio)]
        if not (method == SFM or configure(method) == configure(method, "paper")):
            known = [a for a in known if a.profile == way.profile]
        return known[0].label if known else ""

    def gain(self, way: Way, scene: str, method: str, ratio: float) -> Difference | None:
        """What an arm gained over SfM's points on a scene, dB; None without both."""
        study = self.study(way.strategy)
        if study is None:
            return None
        return gains(study, way.strategy).on_scene.get((scene, self.label(way, method, ratio)))

    def gains(self, way: Way) -> pd.DataFrame:
        """The gains of a way, random's with them."""
        scenes = [*self.scenes(with_depth=False), *self.scenes(with_depth=True)]
        places = [(scene, ratio) for scene in scenes for ratio in self.ratios([scene])]
        methods = (*LAYOUT, RANDOM)
        found = [[self.gain(way, scene, m, ratio) for m in methods] for scene, ratio in places]
        rows = [[math.nan if each is None else each.mean for each in row] for row in found]
        index = pd.MultiIndex.from_tuples(places, names=["scene", "ratio"])
        return pd.DataFrame(rows, index=index, columns=list(methods), dtype=float)

    def repeats(self, way: Way, scene: str, label: str, measure: str) -> pd.Series[float]:
        """A column of ``Study.runs`` by repeat; empty without runs."""
        study = self.study(way.strategy)
        if study is None:
            return pd.Series(dtype=float)
        part = study.under(way.strategy)
        return part.loc[(part["scene"] == scene) & (part["seeds"] == label), measure]


def read_results(benches: Iterable[Path]) -> Results:
    """The runs of several benchmarks' folders, those that are under way too.

    Raises:
        SceneNotFoundError: One of them is not a benchmark's.
    """
    runs = list({run.spec.key: run for bench in benches for run in read_runs(bench)}.values())
    return Results(runs, studies(runs))
