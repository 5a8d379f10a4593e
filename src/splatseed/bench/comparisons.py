"""Comparisons between runs: gains of variants, arms at equal cost, two benchmarks.

A *gain* is the PSNR of a run less that of its baseline, dB, paired by scene and repeat; an *arm* is
a variant with a strategy. A run *reaches* a target when its test PSNR, linear between tests, first
equals it; seconds count making the seeds. Runs that never do are counted, as a mean would flatter.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
import pandas as pd

from splatseed.bench import statistics
from splatseed.bench.plan import SFM, RunResult, RunSpec
from splatseed.bench.runs import Run
from splatseed.bench.statistics import Difference, difference
from splatseed.bench.study import Study, studies, variant_order
from splatseed.text import counted
from splatseed.training.settings import StrategyName

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Gains:
    """What every variant gains over the original cloud under one strategy.

    ``on_scene``: by scene and label; absent where no repeat has both. ``on_these`` and ``on_like``:
    by label, the mean over its scenes, for these scenes alone and for scenes like these.
    """

    strategy: StrategyName
    on_scene: Mapping[tuple[str, str], Difference]
    on_these: Mapping[str, Difference]
    on_like: Mapping[str, Difference]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Scenes on which anything can be compared."""
        return tuple(dict.fromkeys(scene for scene, _ in self.on_scene))

    @property
    def seeds(self) -> tuple[str, ...]:
        """Labels of the variants that can be compared on some scene."""
        return tuple(self.on_these)

    def means(self, scene: str) -> dict[str, float]:
        """Each variant's mean gain on a scene."""
        return {of: each.mean for (where, of), each in self.on_scene.items() if where == scene}

    def top(self, scene: str) -> str:
        """The variant with the greatest gain, or the least loss, ignoring noise; SFM if none."""
        means = self.means(scene)
        return max(means, key=lambda each: means[each], default=SFM)


@lru_cache(maxsize=64)
def gains(study: Study, strategy: StrategyName) -> Gains:
    """The gains under a strategy."""
    on_scene = {}
    for scene in study.scenes_under(strategy):
        scores = study.scores(strategy, scene)
        differences = statistics.paired_differences(scores.to_numpy())
        for label, each in zip(scores.index[1:], differences, strict=True):
            if each is not None:
                on_scene[scene, label] = each
    on_these, on_like = {}, {}
    for label in study.seeded:
        if known := [each for (_, of), each in on_scene.items() if of == label]:
            on_these[label] = statistics.these_scenes(known)
            on_like[label] = statistics.over_scenes([each.mean for each in known])
    return Gains(strategy, _adjusted(on_scene), _adjusted(on_these), _adjusted(on_like))


def _adjusted(family: Mapping[Key, Difference | None]) -> dict[Key, Difference]:
    known = statistics.adjusted(list(family.values()))
    return {key: each for key, each in zip(family, known, strict=True) if each is not None}


def clear_best(study: Study, strategy: StrategyName, scene: str) -> bool:
    """Whether a scene's best arm beats all others beyond noise; False while runs are missing."""
    scores = study.scores(strategy, scene)
    noise, df = statistics.pooled_noise(scores.to_numpy())
    complete = scores.dropna()
    if len(complete) < max(2, len(scores.dropna(how="all"))):
        return False
    second, first = complete.mean(axis=1).sort_values().iloc[-2:]
    lead = difference(first - second, noise * math.sqrt(2 / complete.shape[1]), df, 1)
    # Holm's smallest step: the second is one of all the others.
    return lead.p * (len(complete) - 1) <= statistics.LEVEL


def reach(result: RunResult, target: float) -> tuple[float, float]:
    """Steps and seconds after which a run's test PSNR first is at least ``target``, dB.

    A run above it at its first test has reached it there at the latest; NaN if it never does.
    """
    psnr = np.array([point.psnr for point in result.curve])
    times = np.array([(point.step, point.seconds) for point in result.curve])
    above = np.flatnonzero(psnr >= target)
    if not len(above):
        return math.nan, math.nan
    around = slice(max(above[0] - 1, 0), above[0] + 1)
    steps, seconds = (np.interp(target, psnr[around], each) for each in times[around].T)
    return float(steps), float(seconds) + result.upsample_seconds


def psnr_at(result: RunResult, seconds: float) -> float:
    """A run's test PSNR so many seconds after it began to make seeds, dB.

    NaN before its first test; its last PSNR once it has ended.
    """
    times = [result.upsample_seconds + point.seconds for point in result.curve]
    psnr = [point.psnr for point in result.curve]
    return float(np.interp(seconds, times, psnr, math.nan, result.psnr)) if times else math.nan


class ArmKey(NamedTuple):
    """A strategy, and a variant by its label."""

    strategy: StrategyName
    seeds: str

    @property
    def label(self) -> str:
        """In a few words."""
        return f"{self.seeds} + {self.strategy}"


SCORES = ("psnr", "cc_psnr", "covisible", "ssim", "flip", "lpips")
_TIMED = ("in_time", "steps", "seconds")


@dataclass(frozen=True)
class ComparedArm:
    """An arm compared with the baseline, over the scenes and the pairs of runs that both have.

    ``means``: scores (``SCORES``), numbers of Gaussians and seconds of seeding and training; NaN if
    unknown on some scene. ``gains``: differences of the scores; ``in_time``: PSNR at the seconds at
    which the baseline ends, less its final PSNR, dB; ``steps`` and ``seconds``: mean logarithm of
    those to that PSNR, relative to the baseline's total; None unless all runs tell. ``on_scene``:
    mean difference of PSNR by scene, dB, the lowest first. ``reached``: pairs whose arm reaches
    that PSNR.
    """

    arm: ArmKey
    scenes: tuple[str, ...]
    runs: int
    means: Mapping[str, float]
    gains: Mapping[str, Difference | None]
    on_scene: Mapping[str, float]
    reached: int

    @property
    def gain(self) -> Difference:
        """Difference of PSNR, dB."""
        gain = self.gains["psnr"]
        assert gain is not None  # noqa: S101  (PSNR is always known)
        return gain


def baseline_of(study: Study) -> ArmKey | None:
    """The scene's own points with ``default``, or with the first strategy they were run with."""
    present = set(study.runs.loc[study.runs["seeds"] == SFM, "strategy"])
    known = [each for each in study.strategies if each in present]
    return ArmKey("default" if "default" in known else known[0], SFM) if known else None


@lru_cache(maxsize=64)
def compared_arms(study: Study) -> tuple[ComparedArm, ...]:
    """Every arm compared with the baseline, the one with the highest mean gain first.

    The p values of each kind of difference are adjusted together over the arms.
    """
    base = baseline_of(study)
    if base is None:
        return ()
    beside = study.under(base.strategy)
    beside = beside[beside["seeds"] == SFM]
    pairs = study.runs.merge(beside, on=["scene", "repeat"], suffixes=("", "_base"))
    both = zip(pairs["result_base"], pairs["result"], pairs["spec"], strict=True)
    pairs[[f"{name}_gain" for name in _TIMED]] = [_timed(*each) for each in both]
    for name in SCORES:
        pairs[f"{name}_gain"] = pairs[name] - pairs[f"{name}_base"]
    groups = pairs.groupby(["strategy", "seeds"], sort=False)
    by_arm = {ArmKey(strategy, label): part for (strategy, label), part in groups}
    gained = {}
    for name in (*SCORES, *_TIMED):
        known = {arm: _over_scenes(part, f"{name}_gain") for arm, part in by_arm.items()}
        own = known.pop(base)  # no comparison
        gained[name] = {base: own, **_adjusted(known)}
    columns = [*SCORES, "gaussians", "seeding", "training"]
    compared = []
    for arm, part in by_arm.items():
        scenes, reached = tuple(sorted(set(part["scene"]))), int(part["seconds_gain"].count())
        means = dict(part.groupby("scene")[columns].mean().mean(skipna=False))
        of_arm = {name: each.get(arm) for name, each in gained.items()}
        on_scene = dict(part.groupby("scene")["psnr_gain"].mean().sort_values(kind="stable"))
        compared.append(ComparedArm(arm, scenes, len(part), means, of_arm, on_scene, reached))
    return tuple(sorted(compared, key=lambda each: -each.gain.mean))


def rivals(study: Study) -> list[ComparedArm]:
    """The arms but the baseline that were run on as many scenes as any, the best first.

    The mean of an arm that was run on some scenes only says nothing about it beside the others.
    """
    others = [each for each in compared_arms(study) if each.arm != baseline_of(study)]
    widest = max(others, key=lambda each: len(each.scenes), default=None)
    return [each for each in others if widest and each.scenes == widest.scenes]


def _timed(base: RunResult, own: RunResult, spec: RunSpec) -> tuple[float, float, float]:
    """A pair's values of ``_TIMED``; NaN if unknown."""
    most, (steps, seconds) = spec.training.max_steps, reach(own, base.psnr)
    if math.isnan(seconds) and own.psnr >= base.psnr:  # also the baseline at its own
        steps, seconds = most, own.seconds
    lead = psnr_at(own, base.seconds) - base.psnr
    return lead, math.log(steps / most), math.log(seconds / base.seconds)


def _over_scenes(frame: pd.DataFrame, column: str) -> Difference | None:
    """Mean over scenes with its error over scenes, or over the repeats of one; None if unknown."""
    if frame[column].isna().any():
        return None
    means = frame.groupby("scene")[column].mean()
    return statistics.over_scenes(frame[column] if len(means) == 1 else means)


Place = tuple[StrategyName, str, str]
"""Strategy, variant's label and scene."""


@dataclass(frozen=True)
class Comparison:
    """What changed from benchmark A to B, dB: by place, and by arm over the scenes of both.

    Runs of the two are not paired, as a seed need not mean the same in another version: the noise
    of each is taken from what its own repeats do (of all arms of a scene together), and the test is
    Welch's, adjusted after Holm over all changes. ``settings`` are those that differ, with both
    values; ``only`` are places of "A" or "B" alone; ``notes`` say the rest.
    """

    settings: tuple[tuple[str, str, str], ...]
    changes: Mapping[Place, Difference]
    means: Mapping[ArmKey, Difference]
    only: tuple[tuple[str, str, str, str], ...]
    notes: tuple[str, ...]


def compare(a: Sequence[Run], b: Sequence[Run]) -> Comparison | None:
    """Compare two benchmarks: from each, the set of runs whose settings differ least.

    None if one of them has no finished run.
    """
    sets = studies(a), studies(b)
    pairs = list(product(*sets))
    if not pairs:
        return None
    # Among sets that differ equally, the ones with most in common.
    first, second = both = min(
        pairs, key=lambda pair: (len(_differing(*pair)), -len(_places(pair[0]) & _places(pair[1])))
    )
    apart = [len(each) - 1 for each in sets]
    variants = {**first.variants, **second.variants}

    def ordered(places: set[Place]) -> list[Place]:
        return sorted(places, key=lambda p: (p[0], variant_order((p[1], variants[p[1]])), p[2]))

    here, there = map(_places, both)
    changes = {place: _change(first, second, place) for place in ordered(here & there)}
    by_arm: dict[ArmKey, list[Difference]] = {}
    for (strategy, label, _), each in changes.items():
        by_arm.setdefault(ArmKey(strategy, label), []).append(each)
    settings = _differing(*both)
    scores = [{(r.spec.key, r.result.psnr) for r in runs if r.result} for runs in (a, b)]
    same = len(scores[0] & scores[1])
    digests, beside = [dict[str, str](), dict[str, str]()], [dict[str, str](), dict[str, str]()]
    for i, study in enumerate(both):
        for scene, label, spec in study.runs[["scene", "seeds", "spec"]].to_numpy():
            digests[i][scene] = spec.scene.digest
            beside[i][f"{scene}, {label}"] = spec.scene.depth_digest + spec.scene.cloud_digest
    notes = [
        "" if settings else "All settings are the same.",
        "" if changes else "They have no scene and method in common.",
        f"{counted(same, 'run')} in both, with the same key and score." if same else "",
        *(f"{scene} is not the same in both: its points, cameras or photographs differ."
          for scene in _unequal(*digests)),
        *(f"{place}: its depth maps or its scan are not the same in both."
          for place in _unequal(*beside)),
        f"Other sets of runs are not compared: {apart[0]} of A, {apart[1]} of B." if any(apart)
        else "",
    ]  # fmt: skip
    return Comparison(
        settings,
        _adjusted(changes),
        _adjusted({arm: statistics.these_scenes(each) for arm, each in by_arm.items()}),
        tuple((name, s, scene, v) for name, of in (("A", here - there), ("B", there - here))
              for s, v, scene in ordered(of)),
        tuple(filter(None, notes)),
    )  # fmt: skip


def _unequal(a: Mapping[str, str], b: Mapping[str, str]) -> list[str]:
    return sorted(name for name in a.keys() & b.keys() if a[name] != b[name])


def _places(study: Study) -> set[Place]:
    return set(study.runs[["strategy", "seeds", "scene"]].itertuples(index=False, name=None))


def _differing(a: Study, b: Study) -> tuple[tuple[str, str, str], ...]:
    one, other = (_settings(each, {*a.scenes} & {*b.scenes}) for each in (a, b))
    values = ((name, one.get(name), other.get(name)) for name in one | other)
    return tuple((name, str(x), str(y)) for name, x, y in values if x != y)


def _settings(study: Study, scenes: Iterable[str]) -> dict[str, object]:
    """A study's settings, with the sizes of some scenes alone."""
    told, factors = dict(study.settings), study.settings["data_factor"]
    if isinstance(factors, Mapping):
        sizes = {scene: factors[scene] for scene in sorted(scenes)}
        told["data_factor"] = sizes if len(set(sizes.values())) != 1 else min(sizes.values())
    return told


def _change(a: Study, b: Study, place: Place) -> Difference:
    """B less A, by Welch's test with each benchmark's own noise."""
    strategy, label, scene = place
    parts = []
    for study, sign in ((a, -1), (b, 1)):
        scores = study.scores(strategy, scene)
        rest = scores.sub(scores.mean(axis=1), axis=0).to_numpy()
        df = int(np.isfinite(rest).sum() - scores.notna().any(axis=1).sum())
        own = scores.loc[label].dropna()
        se = math.sqrt(float(np.nansum(rest**2)) / df / len(own)) if df else math.nan
        parts.append(Difference(sign * float(own.mean()), se, df, len(own), math.nan))
    half = statistics.these_scenes(parts)  # a mean of two, with Welch's degrees of freedom
    return difference(2 * half.mean, 2 * half.se, half.df, half.n)
