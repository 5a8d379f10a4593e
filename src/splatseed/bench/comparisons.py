"""Comparisons between runs: gains of variants, arms at equal cost, the paper's, two benchmarks.

A *gain* is the PSNR of a run less that of its baseline, dB, paired by scene and repeat; an *arm* is
a variant with a strategy. A run *reaches* a target when its test PSNR, linear between tests, first
equals it; seconds count making the seeds. Runs that never do are counted, as a mean would flatter.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from splatseed.bench.study import Study, studies, variant_order
from splatseed.literal import counted
from splatseed.seeding.advice import AS_IT_IS, ROOM, Measured, advise
from splatseed.train.settings import StrategyName

Key = TypeVar("Key", bound=Hashable)
_NEVER = (math.nan, math.nan)


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

    def top(self, scene: str) -> str | None:
        """The variant with the greatest gain, or the least loss, on a scene, ignoring noise."""
        means = self.means(scene)
        return max(means, key=lambda each: means[each], default=None)

    def best(self, scene: str) -> str | None:
        """The variant that gains most on a scene, or None if none gains, ignoring noise."""
        top = self.top(scene)
        return top if top is not None and self.on_scene[scene, top].mean > 0 else None


@lru_cache(maxsize=64)
def gains(study: Study, strategy: StrategyName) -> Gains:
    """The gains under a strategy."""
    on_scene = {}
    for scene in study.scenes_under(strategy):
        scores = study.scores(strategy, scene)
        differences = paired_differences(scores.to_numpy())
        for label, each in zip(scores.index[1:], differences, strict=True):
            if each is not None:
                on_scene[scene, label] = each
    by_label = {
        label: known
        for label in study.seeded
        if (known := [each for (_, of), each in on_scene.items() if of == label])
    }
    return Gains(
        strategy,
        _adjusted(on_scene),
        _adjusted({v: these_scenes(each) for v, each in by_label.items()}),
        _adjusted({v: over_scenes([one.mean for one in each]) for v, each in by_label.items()}),
    )


def _adjusted(family: Mapping[Key, Difference]) -> dict[Key, Difference]:
    known = adjusted(list(family.values()))
    return {key: each for key, each in zip(family, known, strict=True) if each is not None}


def clear_best(study: Study, strategy: StrategyName, scene: str) -> bool:
    """Whether a scene's best arm is better than every other one beyond noise."""
    scores = study.scores(strategy, scene)
    noise, df = pooled_noise(scores.to_numpy())
    complete = scores.dropna()
    if math.isnan(noise) or len(complete) < 2:
        return False
    low, high = complete.mean(axis=1).sort_values().iloc[-2:]
    se = max(noise * math.sqrt(2 / complete.shape[1]), np.finfo(float).tiny)
    # Holm's smallest step: the second is one of all the others.
    return difference(high - low, se, df, 1).p * (len(complete) - 1) <= LEVEL


def reach(result: RunResult, target: float) -> tuple[float, float]:
    """Steps and seconds after which a run's test PSNR first is at least ``target``, dB.

    A run above it at its first test has reached it there at the latest; NaN if it never does.
    """
    before = None
    for point in result.curve:
        if point.psnr >= target:
            start = before or point
            flat = before is None or math.isinf(point.psnr) or not point.psnr > start.psnr
            part = 1.0 if flat else (target - start.psnr) / (point.psnr - start.psnr)
            seconds = start.seconds + part * (point.seconds - start.seconds)
            steps = start.step + part * (point.step - start.step)
            return steps, seconds + result.upsample_seconds
        before = point
    return _NEVER


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


def paired_runs(study: Study, runs: pd.DataFrame, strategy: StrategyName) -> pd.DataFrame:
    """Runs beside the baseline's of this strategy, of the same scene and repeat (``X_base``)."""
    base = study.under(strategy)
    base = base[base["seeds"] == SFM]
    return runs.merge(base, on=["scene", "repeat"], suffixes=("", "_base"))


@lru_cache(maxsize=64)
def speeds(study: Study, strategy: StrategyName) -> pd.DataFrame:
    """How soon each variant that has curves is as good as the baseline's final result.

    A row per variant: pairs of runs, those that reach it, means over scenes of steps and seconds of
    these and of base_steps and base_seconds, the baseline's first time; log_steps and log_seconds
    are mean differences of the logarithms (``Difference``), or None unless all reach it.
    """
    pairs, rows = paired_runs(study, study.under(strategy), strategy), {}
    for label in study.seeded_under(strategy):
        part = pairs[pairs["seeds"] == label]
        times = [_times(*each) for each in zip(part["result_base"], part["result"], strict=True)]
        frame = pd.DataFrame(times, columns=["base_steps", "base_seconds", "steps", "seconds"])
        frame = frame.assign(scene=list(part["scene"])).dropna(subset="base_steps")
        if len(frame):
            means = frame.groupby("scene").mean().mean().to_dict()
            rows[label] = {"pairs": len(frame), "reached": int(frame["steps"].count()), **means}
            for kind in ("steps", "seconds"):
                frame["log"] = _log_ratio(frame[kind], frame[f"base_{kind}"])
                rows[label][f"log_{kind}"] = _over(frame, "log", whole=True)
    for log in ("log_steps", "log_seconds"):
        known = adjusted([each[log] for each in rows.values()])
        for each, one in zip(rows.values(), known, strict=True):
            each[log] = one
    return pd.DataFrame(list(rows.values()), index=list(rows), dtype=object)


def _times(base: RunResult, own: RunResult) -> tuple[float, ...]:
    """Steps and seconds to the baseline's last PSNR, of the baseline and of a run; NaN if never."""
    if not base.curve or not own.curve or not math.isfinite(base.curve[-1].psnr):
        return _NEVER + _NEVER
    target = base.curve[-1].psnr
    return reach(base, target) + reach(own, target)


def _log_ratio(own: pd.Series, base: pd.Series) -> pd.Series:
    return np.log(own.clip(lower=1e-9) / base.clip(lower=1e-9))


def _over(frame: pd.DataFrame, column: str, *, whole: bool = False) -> Difference | None:
    """Mean over scenes with its error over scenes, or over the repeats of one.

    None unless known on every scene, or where ``whole`` in every row.
    """
    means = frame.groupby("scene")[column].mean()
    if means.isna().any() or (whole and frame[column].isna().any()):
        return None
    return over_scenes(frame[column].dropna() if len(means) == 1 else means)


class ArmKey(NamedTuple):
    """A strategy, and a variant by its label."""

    strategy: StrategyName
    seeds: str

    @property
    def label(self) -> str:
        """In a few words."""
        return f"{self.seeds} + {self.strategy}"


SCORES = ("psnr", "covisible", "ssim", "lpips")


@dataclass(frozen=True)
class ComparedArm:
    """An arm compared with the baseline, over the scenes and the pairs of runs that both have.

    Args:
        means: Mean scores (``SCORES``), numbers of Gaussians and seconds of seeding and training;
            NaN if unknown on some scene.
        gains: Differences of the scores; ``in_time``: PSNR at the seconds at which the baseline
            ends, less the baseline's final PSNR, dB; ``sooner``: mean logarithm of the seconds to
            the baseline's final PSNR, relative to the baseline's total. None where not all of its
            scenes, for the last two all of its runs, tell.
        reached: Pairs whose arm reaches the baseline's final PSNR.
    """

    arm: ArmKey
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
    pairs = paired_runs(study, study.runs, base.strategy)
    for name in SCORES:
        pairs[f"{name}_gain"] = pairs[name] - pairs[f"{name}_base"]
    times = []
    for first, own in zip(pairs["result_base"], pairs["result"], strict=True):
        _, seconds = reach(own, first.psnr)
        ends = math.isnan(seconds) and own.psnr >= first.psnr  # also the baseline at its own
        in_time = psnr_at(own, first.seconds) - first.psnr
        times.append((in_time, own.seconds if ends else seconds, first.seconds))
    pairs[["in_time", "own", "base"]] = np.array(times, float).reshape(-1, 3)
    pairs["sooner"] = _log_ratio(pairs["own"], pairs["base"])
    by_arm = dict(list(pairs.groupby(["strategy", "seeds"])))
    arms = (ArmKey(strategy, label) for strategy in study.strategies for label in study.variants)
    compared = [_compared(arm, by_arm[arm]) for arm in arms if arm in by_arm]
    others = [each for each in compared if each.arm != base]
    for kind in (*SCORES, "in_time", "sooner"):
        column = adjusted([each.gains[kind] for each in others])
        others = [
            replace(each, gains={**each.gains, kind: known})
            for each, known in zip(others, column, strict=True)
        ]
    compared = [*(each for each in compared if each.arm == base), *others]
    return tuple(sorted(compared, key=lambda each: -each.gain.mean))


def _compared(arm: ArmKey, pairs: pd.DataFrame) -> ComparedArm:
    columns = (*SCORES, "gaussians", "seeding", "training")
    means = pairs.groupby("scene")[list(columns)].mean().mean(skipna=False)
    gained = {name: _over(pairs, f"{name}_gain") for name in SCORES}
    timed = {name: _over(pairs, name, whole=True) for name in ("in_time", "sooner")}
    scenes = tuple(sorted(set(pairs["scene"])))
    reached = int(pairs["sooner"].count())
    return ComparedArm(arm, scenes, len(pairs), dict(means), {**gained, **timed}, reached)


_ROOMS = (1.0, 1.1, 1.3, 1.6, 2.0, 3.0, 5.0, 1e9)
"""Candidate thresholds of the advice; the last leaves every scene as it is."""


def score_advice(study: Study, strategy: StrategyName) -> pd.DataFrame:
    """How good the advice is, leave-one-out: each scene's threshold is fitted on the others only.

    A row per scene has the advised method (``advice``; None without a necessary run) and mean PSNR
    in dB by method.
    """
    psnr = {scene: _by_method(study, strategy, scene) for scene in study.scenes}
    known = {s: each for s, each in psnr.items() if AS_IT_IS in each and "auto" in each}
    base = study.under(strategy)
    base = base[base["seeds"] == SFM].drop_duplicates("scene").set_index("scene")

    def followed(scene: str, room: float) -> str:
        """The advised method, or the scene's points as they are if it was not run."""
        run = base.loc[scene]
        most = run["spec"].most_seeds or int(run["gaussians"])
        said = advise(Measured(int(run["num_seeds"]), 0.0), most, strategy=strategy, room=room)
        return said.method if said.method in known[scene] else AS_IT_IS

    def fitted(others: Sequence[str]) -> float:
        """The threshold that suits the other scenes best; among equals the one in use."""
        if not others:
            return ROOM
        served = {room: fmean(known[s][followed(s, room)] for s in others) for room in _ROOMS}
        return max(_ROOMS, key=lambda room: (round(served[room], 6), room == ROOM))

    advised = {s: followed(s, fitted([other for other in known if other != s])) for s in known}
    rows = [{"advice": advised.get(scene), **each} for scene, each in psnr.items()]
    return pd.DataFrame(rows, index=list(psnr))


def _by_method(study: Study, strategy: StrategyName, scene: str) -> dict[str, float]:
    """Mean PSNR over repeats by method; the first variant stands for its method."""
    means = study.scores(strategy, scene).mean(axis=1).dropna()
    scores: dict[str, float] = {}
    for label in [*means.index[means.index != SFM], *means.index[means.index == SFM]]:
        variant = study.variants[label]
        if variant.profile == "default":
            scores.setdefault(variant.method, float(means[label]))
    return scores


DATASETS = {"mipnerf360": "Mip-NeRF360", "replica": "Replica"}
_PAPER_PSNR = {"mipnerf360": "table1_mipnerf360_psnr.csv", "replica": "table2_replica_psnr.csv"}


@cache
def paper_psnr(key: str) -> pd.DataFrame:
    """The paper's PSNR on a dataset (30,000 steps): a row per scene, a column per method and ratio.

    Example:
        >>> float(paper_psnr("mipnerf360").loc["bonsai", ("sfm", 1.0)])
        32.291
    """
    return _read(_PAPER_PSNR[key]).pivot_table(
        index="scene", columns=["method", "ratio"], values="psnr_db", sort=False
    )


@cache
def paper_gains(key: str) -> pd.DataFrame:
    """The paper's PSNR less that of the cloud as it is, dB."""
    table = paper_psnr(key)
    return table.drop(columns=[(SFM, 1.0)]).sub(table[SFM, 1.0], axis=0)


def paper_costs(key: str) -> pd.DataFrame:
    """The paper's train_time_s and model_size_mb by method and ratio, not of all that it scored."""
    table = _read("table3_time_size.csv")
    return table[table["dataset"] == key].set_index(["method", "ratio"])


def dataset_of(scene: str) -> str:
    """The paper's dataset that has a scene of this name; empty if neither has."""
    return next((key for key in DATASETS if scene in paper_psnr(key).index), "")


@cache
def _read(name: str) -> pd.DataFrame:
    with (files("splatseed.bench") / "data" / name).open(encoding="utf-8") as file:
        return pd.read_csv(file, dtype={"ratio": float})


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
        only: Arms on scenes that only one has: "A" or "B", strategy, scene and label.
        notes: What else there is to say, a sentence each.
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
    pairs = [(one, other) for one in studies(a) for other in studies(b)]
    if not pairs:
        return None
    # Among sets that differ equally, the ones with most in common.
    first, second = both = min(
        pairs, key=lambda pair: (len(_differing(*pair)), -len(_places(pair[0]) & _places(pair[1])))
    )
    known = [*first.variants.items(), *second.variants.items()]
    orders = {variant[0]: variant_order(variant) for variant in known}

    def ordered(places: set[Place]) -> list[Place]:
        return sorted(places, key=lambda each: (each[0], orders[each[1]], each[2]))

    shared = ordered(_places(first) & _places(second))
    changes = {place: _change(first, second, place) for place in shared}
    by_arm: dict[ArmKey, list[Difference]] = {}
    for (strategy, label, _), each in changes.items():
        by_arm.setdefault(ArmKey(strategy, label), []).append(each)
    only = {"A": _places(first) - _places(second), "B": _places(second) - _places(first)}
    settings = _differing(*both)
    scores = [{run.spec.key: run.result.psnr for run in runs if run.result} for runs in (a, b)]
    same = len(scores[0].items() & scores[1].items())
    digests: list[dict[str, str]] = [
        {name: spec.scene.digest for name, spec in
         zip(each.runs["scene"], each.runs["spec"], strict=True)} for each in both
    ]  # fmt: skip
    content = [s for s in sorted(digests[0]) if digests[1].get(s, digests[0][s]) != digests[0][s]]
    notes = [
        "" if settings else "All settings are the same.",
        "" if changes else "They have no scene and method in common.",
        f"{counted(same, 'run')} in both, with the same key and score." if same else "",
        *(f"{each} is not the same in both: its points, cameras or photographs differ."
          for each in content),
    ]  # fmt: skip
    return Comparison(
        settings,
        _adjusted(changes),
        _adjusted({arm: these_scenes(each) for arm, each in by_arm.items()}),
        tuple((name, s, scene, v) for name, of in only.items() for s, v, scene in ordered(of)),
        tuple(filter(None, notes)),
    )


def _places(study: Study) -> set[Place]:
    return set(study.runs[["strategy", "seeds", "scene"]].itertuples(index=False, name=None))


def _differing(a: Study, b: Study) -> tuple[tuple[str, str, str], ...]:
    names = dict.fromkeys([*a.settings, *b.settings])
    values = ((name, a.settings.get(name), b.settings.get(name)) for name in names)
    return tuple((name, str(x), str(y)) for name, x, y in values if x != y)


def _change(a: Study, b: Study, place: Place) -> Difference:
    """B less A, by Welch's test with each benchmark's own noise."""
    strategy, label, scene = place
    means, errors, freedoms, count = [], [], [], 0
    for study in (a, b):
        scores = study.scores(strategy, scene)
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
