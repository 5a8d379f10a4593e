"""Comparisons between runs: gains of variants, arms at equal cost, the paper's, two benchmarks.

Notation: a *gain* is the PSNR of a run less that of its baseline, dB, paired by scene and repeat;
an *arm* is a variant with a strategy. A run *reaches* a target when its test PSNR first equals it;
between two tests of its curve PSNR is interpolated linearly. Seconds include making the seeds and
training. Promise: the p values of one strategy's gains are adjusted together: those on single
scenes as one family, those over scenes as another; those of arms together over all arms. Runs that
never reach a target are counted, not dropped: a mean over the others would flatter.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from importlib.resources import files
from statistics import fmean
from typing import NamedTuple, TypeVar

import numpy as np
import pandas as pd

from splatseed.bench.plan import SFM, RunResult
from splatseed.bench.runs import Run
from splatseed.bench.statistics import (
    LEVEL,
    Difference,
    adjusted,
    difference,
    over_scenes,
    paired_differences,
    pooled_noise,
    these_scenes,
)
from splatseed.bench.study import Study, Variant, studies
from splatseed.seeding.advice import AS_IT_IS, ROOM, Measured, advise
from splatseed.train.settings import StrategyName

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Gains:
    """What every variant gains over the original cloud under one strategy.

    Args:
        strategy: The strategy.
        scenes: Scenes on which anything can be compared.
        seeds: Labels of the variants that can be compared on some scene.
        on_scene: By scene and label; absent where no repeat has both.
        on_these: By label: the mean over its scenes, for these scenes alone.
        on_like: By label: the same mean, for scenes like these.
    """

    strategy: StrategyName
    scenes: tuple[str, ...]
    seeds: tuple[str, ...]
    on_scene: Mapping[tuple[str, str], Difference]
    on_these: Mapping[str, Difference]
    on_like: Mapping[str, Difference]

    def top(self, scene: str) -> str | None:
        """The variant with the greatest gain, or the least loss, on a scene, ignoring noise."""
        means = {of: each.mean for (where, of), each in self.on_scene.items() if where == scene}
        return max(means, key=lambda each: means[each], default=None)

    def best(self, scene: str) -> str | None:
        """The variant that gains most on a scene, or None if none gains, ignoring noise."""
        top = self.top(scene)
        return top if top is not None and self.on_scene[scene, top].mean > 0 else None

    def means(self) -> dict[str, dict[str, float]]:
        """Mean gains by scene and variant."""
        return {
            scene: {of: each.mean for (where, of), each in self.on_scene.items() if where == scene}
            for scene in self.scenes
        }


@lru_cache(maxsize=64)
def gains(study: Study, strategy: StrategyName) -> Gains:
    """The gains under a strategy."""
    on_scene = {}
    for scene in study.scenes_under(strategy):
        scores = _scores(study, strategy, scene)
        differences = paired_differences(scores.to_numpy())
        for label, each in zip(scores.index[1:], differences, strict=True):
            if each is not None:
                on_scene[scene, label] = each
    seeds = tuple(label for label in study.seeded if any(label == of for _, of in on_scene))
    by_label = {v: [each for (_, of), each in on_scene.items() if of == v] for v in seeds}
    return Gains(
        strategy,
        tuple(s for s in study.scenes if any(s == scene for scene, _ in on_scene)),
        seeds,
        _adjusted(on_scene),
        _adjusted({v: these_scenes(each) for v, each in by_label.items()}),
        _adjusted({v: over_scenes([one.mean for one in each]) for v, each in by_label.items()}),
    )


def _scores(study: Study, strategy: StrategyName, scene: str) -> pd.DataFrame:
    """PSNR of a scene, [A, R]: a row per arm, the baseline first, NaN where there is no run."""
    part = study.under(strategy)
    scores = part[part["scene"] == scene].pivot_table(
        index="seeds", columns="repeat", values="psnr"
    )
    return scores.reindex([SFM, *study.seeded_under(strategy)])


def _adjusted(family: Mapping[Key, Difference]) -> dict[Key, Difference]:
    known = adjusted(list(family.values()))
    return {key: each for key, each in zip(family, known, strict=True) if each is not None}


def clear_best(study: Study, strategy: StrategyName, scene: str) -> bool:
    """Whether a scene's best arm is better than every other one beyond noise."""
    scores = _scores(study, strategy, scene)
    noise, df = pooled_noise(scores.to_numpy())
    complete = scores.dropna()
    if math.isnan(noise) or len(complete) < 2:
        return False
    low, high = complete.mean(axis=1).sort_values().iloc[-2:]
    se = max(noise * math.sqrt(2 / complete.shape[1]), np.finfo(float).tiny)
    # Holm's smallest step: the second is one of all the others.
    return difference(high - low, se, df, 1).p * (len(complete) - 1) <= LEVEL


class MeanGains(NamedTuple):
    """Three mean gains over scenes that are easily mistaken for one another; dB.

    ``over_all``: of all variants together, that of a variant picked blindly. ``over_best``: of
    ``best``, the variant that gains most on average; slightly optimistic, as it was chosen by the
    same scores. ``per_scene``: of the best variant of each scene, chosen by the test views it is
    scored on; not a gain that anybody can have. Variants are those that every scene has.
    """

    over_all: float
    best: str
    over_best: float
    per_scene: float
    num_scenes: int
    num_variants: int


def mean_gains(by_scene: Mapping[str, Mapping[str, float]]) -> MeanGains | None:
    """The three means of gains.

    Args:
        by_scene: Gains in dB by scene and variant. Variants that some scene lacks are left out.

    Returns:
        None where no variant is left.
    """
    table = pd.DataFrame.from_dict(dict(by_scene), orient="index").dropna(axis=1)
    if table.empty:
        return None
    means = table.mean()
    best = means.idxmax()
    per_scene = float(table.max(axis=1).mean())
    return MeanGains(float(means.mean()), best, float(means[best]), per_scene, *table.shape)


class Reached(NamedTuple):
    """When a target was reached: steps done, and seconds with upsampling."""

    steps: float
    seconds: float


def reach(result: RunResult, target: float) -> Reached | None:
    """When a run's test PSNR first is at least ``target``, dB; None if it never is.

    A run above it at its first test has reached it there at the latest.
    """
    before = None
    for point in result.curve:
        if point.psnr >= target:
            start = before or point
            flat = before is None or math.isinf(point.psnr) or not point.psnr > start.psnr
            part = 1.0 if flat else (target - start.psnr) / (point.psnr - start.psnr)
            seconds = start.seconds + part * (point.seconds - start.seconds)
            steps = start.step + part * (point.step - start.step)
            return Reached(steps, seconds + result.upsample_seconds)
        before = point
    return None


def psnr_at(result: RunResult, seconds: float) -> float:
    """A run's test PSNR so many seconds after it began to make seeds, dB.

    NaN before its first test; its last PSNR once it has ended.
    """
    times = [result.upsample_seconds + point.seconds for point in result.curve]
    if not times or seconds < times[0]:
        return math.nan
    if seconds >= times[-1]:
        return result.psnr
    return float(np.interp(seconds, times, [point.psnr for point in result.curve]))


class Speed(NamedTuple):
    """How soon a variant reaches the baseline's last PSNR: in ``reached`` of ``pairs`` of runs.

    ``means``: means over scenes of steps and seconds of those that reach it, and of base_steps and
    base_seconds, the baseline's first time; NaN if there are none. ``log_steps``, ``log_seconds``:
    mean differences of the logarithms, if all reach it.
    """

    pairs: int
    reached: int
    means: Mapping[str, float]
    log_steps: Difference | None
    log_seconds: Difference | None


@lru_cache(maxsize=64)
def speeds(study: Study, strategy: StrategyName) -> dict[str, Speed]:
    """How soon each variant that has curves is as good as the baseline's final result."""
    pairs = paired_runs(study, study.under(strategy), strategy)
    told = {}
    for label in study.seeded_under(strategy):
        part = pairs[pairs["seeds"] == label]
        times = [_times(*each) for each in zip(part["result_base"], part["result"], strict=True)]
        frame = pd.DataFrame(times, columns=["base_steps", "base_seconds", "steps", "seconds"])
        frame = frame.assign(scene=list(part["scene"])).dropna(subset="base_steps")
        if len(frame):
            for kind in ("steps", "seconds"):
                frame[f"log_{kind}"] = _log_ratio(frame[kind], frame[f"base_{kind}"])
            means = {name: _over_scenes(frame, name) for name in frame.columns if name != "scene"}
            reached = int(frame["steps"].notna().sum())
            logs = [_over(frame, f"log_{kind}", whole=True) for kind in ("steps", "seconds")]
            told[label] = Speed(len(frame), reached, means, *logs)
    known = [adjusted([getattr(each, log) for each in told.values()])
             for log in ("log_steps", "log_seconds")]  # fmt: skip
    return {
        label: each._replace(log_steps=steps, log_seconds=seconds)
        for (label, each), steps, seconds in zip(told.items(), *known, strict=True)
    }


def paired_runs(study: Study, runs: pd.DataFrame, strategy: StrategyName) -> pd.DataFrame:
    """Runs beside the baseline's of this strategy, of the same scene and repeat (``X_base``)."""
    base = study.under(strategy)
    base = base[base["seeds"] == SFM]
    return runs.merge(base, on=["scene", "repeat"], suffixes=("", "_base"))


def _times(base: RunResult, own: RunResult) -> tuple[float, ...]:
    """Steps and seconds to the baseline's last PSNR, of the baseline and of a run; NaN if never."""
    never = (math.nan, math.nan)
    if not base.curve or not own.curve or not math.isfinite(base.curve[-1].psnr):
        return never + never
    target = base.curve[-1].psnr
    return (*(reach(base, target) or never), *(reach(own, target) or never))


def _log_ratio(own: pd.Series, base: pd.Series) -> pd.Series:
    return np.log(own.clip(lower=1e-9) / base.clip(lower=1e-9))


def _over_scenes(frame: pd.DataFrame, column: str) -> float:
    """Mean over scenes of the means over repeats, of what is known."""
    return float(frame.groupby("scene")[column].mean().mean())


def _over(frame: pd.DataFrame, column: str, *, whole: bool = False) -> Difference | None:
    """Mean over scenes with its error over scenes, or over the repeats of one.

    None unless known on every scene, or where ``whole`` in every row.
    """
    means = frame.groupby("scene")[column].mean()
    if means.isna().any() or (whole and frame[column].isna().any()):
        return None
    return over_scenes(frame[column].dropna() if len(means) == 1 else means)


class Arm(NamedTuple):
    """A variant by its label, and a strategy."""

    strategy: StrategyName
    seeds: str

    @property
    def label(self) -> str:
        """In a few words."""
        return f"{self.seeds} + {self.strategy}"


_SCORES = ("psnr", "covisible", "ssim", "lpips")


@dataclass(frozen=True)
class ComparedArm:
    """An arm compared with the baseline, over the scenes that both have.

    Args:
        arm: The arm.
        scenes: These scenes.
        runs: Pairs of runs behind the differences.
        means: Mean scores (psnr, covisible, ssim, lpips), numbers of Gaussians and seconds of
            seeding and training; NaN if unknown on some scene.
        gains: Differences of the scores; ``in_time``: PSNR at the seconds at which the baseline
            ends, less the baseline's final PSNR, dB; ``sooner``: mean logarithm of the seconds to
            the baseline's final PSNR, relative to the baseline's total. None where not all of its
            scenes, for the last two all of its runs, tell.
        reached: Pairs whose arm reaches the baseline's final PSNR.
    """

    arm: Arm
    scenes: tuple[str, ...]
    runs: int
    means: Mapping[str, float]
    gains: Mapping[str, Difference | None]
    reached: int

    @property
    def gain(self) -> Difference:
        """Difference of PSNR, dB."""
        gain = self.gains["psnr"]
        assert gain is not None  # noqa: S101  (PSNR is always known)
        return gain


def baseline_of(study: Study) -> Arm | None:
    """The scene's own points with ``default``, or with the first strategy they were run with."""
    present = set(study.runs.loc[study.runs["seeds"] == SFM, "strategy"])
    known = [each for each in study.strategies if each in present]
    if not known:
        return None
    return Arm("default" if "default" in known else known[0], SFM)


@lru_cache(maxsize=64)
def compared_arms(study: Study) -> tuple[ComparedArm, ...]:
    """Every arm compared with the baseline, the one with the highest mean gain first.

    The p values of each kind of difference are adjusted together over the arms.
    """
    base = baseline_of(study)
    if base is None:
        return ()
    pairs = paired_runs(study, study.runs, base.strategy)
    for name in _SCORES:
        pairs[f"{name}_gain"] = pairs[name] - pairs[f"{name}_base"]
    both = list(zip(pairs["result_base"], pairs["result"], strict=True))
    pairs["in_time"] = [psnr_at(own, first.seconds) - first.psnr for first, own in both]
    total = pd.Series([first.seconds for first, _ in both], pairs.index, dtype=float)
    pairs["sooner"] = _log_ratio(
        pd.Series([_seconds_to(own, first.psnr) for first, own in both], pairs.index, float), total
    )
    arms = [Arm(strategy, label) for strategy in study.strategies for label in study.variants]
    compared = [
        _compared(arm, part)
        for arm in arms
        if len(part := pairs[(pairs["strategy"] == arm.strategy) & (pairs["seeds"] == arm.seeds)])
    ]
    others = [each for each in compared if each.arm != base]
    for kind in others[0].gains if others else ():
        column = adjusted([each.gains[kind] for each in others])
        others = [
            replace(each, gains={**each.gains, kind: known})
            for each, known in zip(others, column, strict=True)
        ]
    compared = [*(each for each in compared if each.arm == base), *others]
    return tuple(sorted(compared, key=lambda each: -each.gain.mean))


def _compared(arm: Arm, pairs: pd.DataFrame) -> ComparedArm:
    columns = (*_SCORES, "gaussians", "seeding", "training")
    means = pairs.groupby("scene")[list(columns)].mean().mean(skipna=False)
    gained = {name: _over(pairs, f"{name}_gain") for name in _SCORES}
    timed = {name: _over(pairs, name, whole=True) for name in ("in_time", "sooner")}
    scenes = tuple(sorted(set(pairs["scene"])))
    reached = int(pairs["sooner"].notna().sum())
    return ComparedArm(arm, scenes, len(pairs), dict(means), {**gained, **timed}, reached)


def _seconds_to(own: RunResult, target: float) -> float:
    """When a run reaches that PSNR, also the baseline its own; NaN if it never does."""
    reached = reach(own, target)
    if reached is not None:
        return reached.seconds
    return own.seconds if own.psnr >= target else math.nan


class AdviceScore(NamedTuple):
    """How good the advice is, scene by scene: leave-one-out.

    ``advised``: the advised method by scene, its threshold fitted on the other scenes only;
    ``psnr``: mean PSNR by scene and method, dB; ``left_out``: scenes that lack a necessary run.
    """

    advised: Mapping[str, str]
    psnr: Mapping[str, Mapping[str, float]]
    left_out: tuple[str, ...]

    def gain_over(self, scene: str, method: str) -> float:
        """The gain of the advice on a scene over always taking one method, dB; NaN if unknown."""
        scores = self.psnr[scene]
        return scores[self.advised[scene]] - scores.get(method, math.nan)

    def best(self, scene: str) -> str:
        """The method of the arm that scored highest."""
        return max(self.psnr[scene], key=lambda each: self.psnr[scene][each])


_ROOMS = (1.0, 1.1, 1.3, 1.6, 2.0, 3.0, 5.0, 1e9)
"""Candidate thresholds of the advice; the last leaves every scene as it is."""


def score_advice(study: Study, strategy: StrategyName) -> AdviceScore:
    """Advise each scene with a threshold fitted on the others, and look up the result."""
    psnr = {scene: _by_method(study, strategy, scene) for scene in study.scenes}
    known = {s: each for s, each in psnr.items() if AS_IT_IS in each and "auto" in each}
    base = study.under(strategy)
    base = base[base["seeds"] == SFM].drop_duplicates("scene").set_index("scene")

    def followed(scene: str, room: float) -> str:
        """The advised method, or the scene's points as they are if it was not run."""
        run = base.loc[scene]
        most = study.specs[run["key"]].most_seeds or int(run["gaussians"])
        said = advise(Measured(int(run["num_seeds"]), 0.0), most, strategy=strategy, room=room)
        return said.method if said.method in known[scene] else AS_IT_IS

    def fitted(others: Sequence[str]) -> float:
        """The threshold that suits the other scenes best; among equals the one in use."""
        if not others:
            return ROOM
        served = {room: fmean(known[s][followed(s, room)] for s in others) for room in _ROOMS}
        return max(_ROOMS, key=lambda room: (round(served[room], 6), room == ROOM))

    advised = {s: followed(s, fitted([other for other in known if other != s])) for s in known}
    return AdviceScore(advised, known, tuple(s for s in psnr if s not in known))


def _by_method(study: Study, strategy: StrategyName, scene: str) -> dict[str, float]:
    """Mean PSNR over repeats by method; the first variant stands for its method."""
    means = _scores(study, strategy, scene).mean(axis=1).dropna()
    scores: dict[str, float] = {}
    for label in [*means.index[means.index != SFM], *means.index[means.index == SFM]]:
        variant = study.variants[label]
        if variant.profile == "default":
            scores.setdefault(variant.method, float(means[label]))
    return scores


Entry = tuple[str, float]
"""Method and ratio; ``("sfm", 1.0)`` for the original cloud."""
PAPER_STEPS = 30_000
DATASETS = {"mipnerf360": "Mip-NeRF360", "replica": "Replica"}


@dataclass(frozen=True)
class PaperDataset:
    """The paper's results on a dataset, from its tables 1 to 3: 30,000 steps; spread unknown.

    Args:
        key: As in ``DATASETS``.
        psnr: PSNR in dB by scene and entry.
        costs: Training seconds and model size in MB by entry, means over scenes; not of all
            entries that ``psnr`` has.
    """

    key: str
    psnr: Mapping[str, Mapping[Entry, float]]
    costs: Mapping[Entry, tuple[float, float]]

    @property
    def title(self) -> str:
        """The dataset's name."""
        return DATASETS[self.key]

    def gain(self, scene: str, variant: Variant) -> float:
        """PSNR of a variant on a scene less that of the cloud as it is, dB; NaN where unknown."""
        scores = self.psnr.get(scene, {})
        return scores.get((variant.method, variant.ratio), math.nan) - scores.get((SFM, 1.0), 0.0)

    def gains(self) -> dict[str, dict[str, float]]:
        """All gains by scene and variant, dB."""
        variants = {
            scene: [Variant(method, ratio=ratio) for method, ratio in each if method != SFM]
            for scene, each in self.psnr.items()
        }
        return {s: {v.label: self.gain(s, v) for v in each} for s, each in variants.items()}


@cache
def paper_dataset(key: str) -> PaperDataset:
    """The paper's numbers of a dataset.

    Args:
        key: As in ``DATASETS``.

    Example:
        >>> paper_dataset("mipnerf360").psnr["bonsai"]["sfm", 1.0]
        32.291
    """
    psnr: dict[str, dict[Entry, float]] = {}
    name = {"mipnerf360": "table1_mipnerf360_psnr.csv", "replica": "table2_replica_psnr.csv"}[key]
    for row in _read(name):
        entry = row["method"], float(row["ratio"])
        psnr.setdefault(row["scene"], {})[entry] = float(row["psnr_db"])
    costs = {
        (row["method"], float(row["ratio"])): (
            float(row["train_time_s"]),
            float(row["model_size_mb"]),
        )
        for row in _read("table3_time_size.csv")
        if row["dataset"] == key
    }
    return PaperDataset(key, psnr, costs)


def dataset_of(scene: str) -> PaperDataset | None:
    """The paper's dataset that has a scene of this name; None if neither has."""
    datasets = (paper_dataset(key) for key in DATASETS)
    return next((each for each in datasets if scene in each.psnr), None)


def _read(name: str) -> list[dict[str, str]]:
    text = (files("splatseed.bench") / "data" / name).read_text("utf-8")
    return list(csv.DictReader(text.splitlines()))


Place = tuple[StrategyName, str, str]
"""Strategy, variant's label and scene."""


@dataclass(frozen=True)
class Comparison:
    """The comparison of two benchmarks, A and B.

    Runs of the two are not paired, as a seed need not mean the same in another version: the noise
    of each is taken from what its own repeats do (of all arms of a scene together), and the test is
    Welch's, adjusted after Holm over all changes.

    Args:
        settings: Settings that differ, with A's value and B's.
        changes: B less A of each arm on each scene that both have, dB.
        means: The mean change of each arm over these scenes.
        only_a: Arms on scenes that only A has.
        only_b: Likewise for B.
        same_runs: Runs that are in both, with the same key and the same PSNR.
        content: Scenes of the same name whose files differ.
    """

    settings: tuple[tuple[str, str, str], ...]
    changes: Mapping[Place, Difference]
    means: Mapping[Arm, Difference]
    only_a: tuple[Place, ...] = ()
    only_b: tuple[Place, ...] = ()
    same_runs: int = 0
    content: tuple[str, ...] = field(default=())


def compare(a: Sequence[Run], b: Sequence[Run]) -> Comparison | None:
    """Compare two benchmarks: from each, the set of runs whose settings differ least.

    Args:
        a: The runs of the first.
        b: The runs of the second.

    Returns:
        None if one of them has no finished run.
    """
    pairs = [(one, other) for one in studies(a) for other in studies(b)]
    if not pairs:
        return None
    first, second = min(pairs, key=_distance)
    orders = {label: each.order for label, each in {**first.variants, **second.variants}.items()}

    def ordered(places: set[Place]) -> tuple[Place, ...]:
        return tuple(sorted(places, key=lambda each: (each[0], orders[each[1]], each[2])))

    shared = ordered(_places(first) & _places(second))
    changes = {place: _change(first, second, place) for place in shared}
    by_arm: dict[Arm, list[Difference]] = {}
    for (strategy, label, _), each in changes.items():
        by_arm.setdefault(Arm(strategy, label), []).append(each)
    scores = [{run.spec.key: run.result.psnr for run in runs if run.result} for runs in (a, b)]
    digests = [dict(zip(each.runs["scene"], each.runs["digest"], strict=True))
               for each in (first, second)]  # fmt: skip
    common = digests[0].keys() & digests[1].keys()
    return Comparison(
        settings=_differing(first, second),
        changes=_adjusted(changes),
        means=_adjusted({arm: these_scenes(each) for arm, each in by_arm.items()}),
        only_a=ordered(_places(first) - _places(second)),
        only_b=ordered(_places(second) - _places(first)),
        same_runs=len(scores[0].items() & scores[1].items()),
        content=tuple(sorted(scene for scene in common if digests[0][scene] != digests[1][scene])),
    )


def _places(study: Study) -> set[Place]:
    return set(study.runs[["strategy", "seeds", "scene"]].itertuples(index=False, name=None))


def _distance(pair: tuple[Study, Study]) -> tuple[int, int]:
    """How many settings of two studies differ; among equals, the one with most in common."""
    return len(_differing(*pair)), -len(_places(pair[0]) & _places(pair[1]))


def _differing(a: Study, b: Study) -> tuple[tuple[str, str, str], ...]:
    names = dict.fromkeys([*a.settings, *b.settings])
    values = ((name, a.settings.get(name), b.settings.get(name)) for name in names)
    return tuple((name, str(x), str(y)) for name, x, y in values if x != y)


def _change(a: Study, b: Study, place: Place) -> Difference:
    """B less A, by Welch's test with each benchmark's own noise."""
    strategy, label, scene = place
    means, errors, freedoms, count = [], [], [], 0
    for study in (a, b):
        scores = _scores(study, strategy, scene)
        rest = scores.sub(scores.mean(axis=1), axis=0).to_numpy()
        df = int(np.isfinite(rest).sum() - scores.notna().any(axis=1).sum())
        own = scores.loc[label].dropna()
        means.append(float(own.mean()))
        errors.append(float(np.nansum(rest**2)) / df / len(own) if df else math.nan)
        freedoms.append(df)
        count += len(own)
    total = sum(errors)
    if math.isnan(total):
        return difference(means[1] - means[0], math.nan, 0, count)
    weight = sum(error**2 / df for error, df in zip(errors, freedoms, strict=True))
    freedom = total**2 / weight if total > 0 else float(sum(freedoms))
    return difference(means[1] - means[0], math.sqrt(total), freedom, count)
