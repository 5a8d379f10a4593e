"""Compare runs: gains of variants, and arms at equal cost.

A *gain* is the PSNR of a run minus that of its baseline in dB, paired by scene and repeat. An *arm*
is a variant with a strategy. A run *reaches* a target when its test PSNR, interpolated linearly
between tests, first equals it. Seconds include seeding.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
import pandas as pd

from splatseed.bench import statistics
from splatseed.bench.plan import SFM, RunResult, RunSpec
from splatseed.bench.statistics import Difference, difference
from splatseed.bench.study import Study
from splatseed.training.settings import StrategyName

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Gains:
    """The gains of all variants over the baseline under one strategy.

    ``on_scene``: by scene and label, if some repeat has both runs. ``on_these``, ``on_like``: by
    label, the mean over scenes, with the error for these scenes and for scenes like these.
    """

    on_scene: Mapping[tuple[str, str], Difference]
    on_these: Mapping[str, Difference]
    on_like: Mapping[str, Difference]

    @property
    def scenes(self) -> tuple[str, ...]:
        """The scenes with a gain."""
        return tuple(dict.fromkeys(scene for scene, _ in self.on_scene))

    @property
    def seeds(self) -> tuple[str, ...]:
        """The labels of the variants with a gain."""
        return tuple(self.on_these)

    def top(self, scene: str) -> str:
        """The variant with the highest mean gain on a scene; SFM if there are no gains."""
        means = {label: gain.mean for (of, label), gain in self.on_scene.items() if of == scene}
        return max(means, key=lambda label: means[label], default=SFM)


@lru_cache(maxsize=64)
def gains(study: Study, strategy: StrategyName) -> Gains:
    """Compute the gains under a strategy."""
    on_scene = {}
    for scene in study.scenes_under(strategy):
        scores = study.scores(strategy, scene)
        differences = statistics.paired_differences(scores.to_numpy())
        for label, gain in zip(scores.index[1:], differences, strict=True):
            if gain is not None:
                on_scene[scene, label] = gain
    on_these, on_like = {}, {}
    for label in study.seeded:
        if known := [gain for (_, of), gain in on_scene.items() if of == label]:
            on_these[label] = statistics.these_scenes(known)
            on_like[label] = statistics.over_scenes([gain.mean for gain in known])
    return Gains(_adjusted(on_scene), _adjusted(on_these), _adjusted(on_like))


def _adjusted(family: Mapping[Key, Difference | None]) -> dict[Key, Difference]:
    known = statistics.adjusted(list(family.values()))
    return {key: gain for key, gain in zip(family, known, strict=True) if gain is not None}


def clear_best(study: Study, strategy: StrategyName, scene: str) -> bool:
    """Whether the best arm of a scene is significantly better than the second; needs all runs."""
    scores = study.scores(strategy, scene)
    noise, df = statistics.pooled_noise(scores.to_numpy())
    complete = scores.dropna()
    if len(complete) < max(2, len(scores.dropna(how="all"))):
        return False
    second, first = complete.mean(axis=1).sort_values().iloc[-2:]
    repeats = complete.shape[1]
    lead = difference(first - second, noise * math.sqrt(2 / repeats), df, repeats)
    # The first step of Holm: the second arm was chosen among all others.
    return replace(lead, adjusted=lead.p * (len(complete) - 1)).verdict == "better"


def reach(result: RunResult, target: float) -> tuple[float, float]:
    """Compute the steps and seconds at which a run first reaches a test PSNR of ``target`` dB.

    Those of the first test if it is above the target there; NaN if it never is.
    """
    psnr = np.array([point.psnr for point in result.curve])
    times = np.array([(point.step, point.seconds) for point in result.curve])
    above = np.flatnonzero(psnr >= target)
    if not len(above):
        return math.nan, math.nan
    around = slice(max(above[0] - 1, 0), above[0] + 1)
    steps, seconds = (np.interp(target, psnr[around], axis) for axis in times[around].T)
    return float(steps), float(seconds) + result.upsample_seconds


def psnr_at(result: RunResult, seconds: float) -> float:
    """Interpolate the test PSNR of a run at a time since the start of seeding, in dB.

    NaN before its first test; its final PSNR after its end.
    """
    times = [result.upsample_seconds + point.seconds for point in result.curve]
    psnr = [point.psnr for point in result.curve]
    return float(np.interp(seconds, times, psnr, math.nan, result.psnr)) if times else math.nan


class ArmKey(NamedTuple):
    """A strategy, and the label of a variant."""

    strategy: StrategyName
    seeds: str

    @property
    def label(self) -> str:
        """The name in reports."""
        return f"{self.seeds} + {self.strategy}"


SCORES = ("psnr", "cc_psnr", "covisible", "ssim", "flip", "lpips")
_TIMED = ("in_time", "steps", "seconds")


@dataclass(frozen=True)
class ComparedArm:
    """An arm compared with the baseline, over the pairs of runs that both have.

    ``means``: ``SCORES``, numbers of Gaussians, and seconds of seeding and training; NaN if unknown
    on some scene. ``gains``, None if unknown in some pair: differences of the scores; ``in_time``,
    PSNR when the baseline ends minus the baseline's final PSNR, in dB; ``steps`` and ``seconds``,
    the mean logarithm of those to the baseline's final PSNR, relative to the baseline's total.
    ``on_scene``: gain in PSNR by scene in dB, the lowest first; empty for the baseline.
    ``reached``: number of pairs in which the arm reaches the baseline's final PSNR.
    """

    arm: ArmKey
    scenes: tuple[str, ...]
    runs: int
    means: Mapping[str, float]
    gains: Mapping[str, Difference | None]
    on_scene: Mapping[str, Difference]
    reached: int

    @property
    def gain(self) -> Difference:
        """The gain in PSNR, in dB."""
        gain = self.gains["psnr"]
        assert gain is not None  # noqa: S101  (PSNR is always known)
        return gain


def baseline_of(study: Study) -> ArmKey | None:
    """The arm of the original points under ``default``, or else under the first strategy run."""
    present = set(study.runs.loc[study.runs["seeds"] == SFM, "strategy"])
    known = [strategy for strategy in study.strategies if strategy in present]
    return ArmKey("default" if "default" in known else known[0], SFM) if known else None


@lru_cache(maxsize=64)
def compared_arms(study: Study) -> tuple[ComparedArm, ...]:
    """Compare every arm with the baseline; returns them in order of mean gain.

    The p values of each score are adjusted over the arms of a strategy, and those on scenes over
    all of them, as in ``gains``: the same comparison has the same verdict in both.
    """
    base = baseline_of(study)
    if base is None:
        return ()
    baseline = study.under(base.strategy)
    baseline = baseline[baseline["seeds"] == SFM]
    pairs = study.runs.merge(baseline, on=["scene", "repeat"], suffixes=("", "_base"))
    both = zip(pairs["result_base"], pairs["result"], pairs["spec"], strict=True)
    pairs[[f"{name}_gain" for name in _TIMED]] = [_timed(*each) for each in both]
    for name in SCORES:
        pairs[f"{name}_gain"] = pairs[name] - pairs[f"{name}_base"]
    groups = pairs.groupby(["strategy", "seeds"], sort=False)
    by_arm = {ArmKey(strategy, label): part for (strategy, label), part in groups}
    mean_gain = _MeanGains(study, pairs, base)
    gained = {}
    for name in (*SCORES, *_TIMED):
        known = {arm: mean_gain(arm, part, name) for arm, part in by_arm.items()}
        gained[name] = {base: known.pop(base)}  # with itself: not in a family
        for strategy in study.strategies:
            family = {arm: gain for arm, gain in known.items() if arm.strategy == strategy}
            gained[name] |= _adjusted(family)
    columns = [*SCORES, "gaussians", "seeding", "training"]
    on_scenes = dict[tuple[ArmKey, str], Difference]()
    for strategy in study.strategies:
        places = [(arm, scene) for arm, part in by_arm.items() if arm.strategy == strategy
                  and arm != base for scene in sorted(set(part["scene"]))]  # fmt: skip
        on_scenes |= _adjusted({place: mean_gain.on_scene(*place, "psnr") for place in places})
    compared = []
    for arm, part in by_arm.items():
        scenes, reached = tuple(sorted(set(part["scene"]))), int(part["seconds_gain"].count())
        means = dict(part.groupby("scene")[columns].mean().mean(skipna=False))
        of_arm = {name: by_name.get(arm) for name, by_name in gained.items()}
        own = {scene: gain for (of, scene), gain in on_scenes.items() if of == arm}
        on_scene = dict(sorted(own.items(), key=lambda item: item[1].mean))
        compared.append(ComparedArm(arm, scenes, len(part), means, of_arm, on_scene, reached))
    return tuple(sorted(compared, key=lambda arm: -arm.gain.mean))


def rivals(study: Study) -> list[ComparedArm]:
    """The arms other than the baseline with runs on most scenes, in order of mean gain.

    Means over different scenes are not comparable.
    """
    others = [arm for arm in compared_arms(study) if arm.arm != baseline_of(study)]
    widest = max(others, key=lambda arm: len(arm.scenes), default=None)
    return [arm for arm in others if widest and arm.scenes == widest.scenes]


def _timed(base: RunResult, own: RunResult, spec: RunSpec) -> tuple[float, float, float]:
    """Compute the values of ``_TIMED`` for a pair of runs; NaN if unknown."""
    max_steps, (steps, seconds) = spec.training.max_steps, reach(own, base.psnr)
    if math.isnan(seconds) and own.psnr >= base.psnr:  # at its end, as does the baseline
        steps, seconds = max_steps, own.seconds
    lead = psnr_at(own, base.seconds) - base.psnr
    return lead, math.log(steps / max_steps), math.log(seconds / base.seconds)


class _MeanGains:
    """Average gains over scenes, or over the repeats of a single scene.

    The noise of a single scene is pooled over all arms of the two strategies, as in ``gains``. That
    of relative times is the arm's own, as the baseline has none.
    """

    def __init__(self, study: Study, pairs: pd.DataFrame, base: ArmKey) -> None:
        self._study, self._pairs, self._base = study, pairs, base
        self._on_scene: dict[tuple[str, str, str], dict[ArmKey, Difference | None]] = {}

    def __call__(self, arm: ArmKey, part: pd.DataFrame, name: str) -> Difference | None:
        """Average one over the pairs of an arm; None if one of them is unknown."""
        column = part[f"{name}_gain"]
        if column.isna().any():
            return None
        means = column.groupby(part["scene"]).mean()
        if len(means) > 1:
            return statistics.over_scenes(means)
        if name in {"steps", "seconds"} or arm == self._base:
            return statistics.over_scenes(column, "repeat")
        return self.on_scene(arm, str(means.index[0]), name)

    def on_scene(self, arm: ArmKey, scene: str, name: str) -> Difference | None:
        """Average one over the pairs of an arm other than the baseline on one scene."""
        place = arm.strategy, scene, name
        if place not in self._on_scene:
            self._on_scene[place] = self._differences(*place)
        return self._on_scene[place][arm]

    def _differences(
        self, strategy: StrategyName, scene: str, name: str
    ) -> dict[ArmKey, Difference | None]:
        """Compare the arms of a strategy with the baseline on one scene."""
        scored = name in SCORES
        runs, value = (self._study.runs, name) if scored else (self._pairs, f"{name}_gain")
        near = runs["strategy"].isin({strategy, self._base.strategy}) & (runs["scene"] == scene)
        scores = runs[near].pivot_table(index=["strategy", "seeds"], columns="repeat", values=value)
        others = [ArmKey(*each) for each in scores.index if each != self._base]
        differences = statistics.paired_differences(scores.loc[[self._base, *others]].to_numpy())
        return dict(zip(others, differences, strict=True))
