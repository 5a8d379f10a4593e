"""Arms of any seeds and strategy against one baseline: at equal numbers and at equal seconds.

Notation: an *arm* is a variant (how seeds are made) with a strategy; the *baseline* is the scene's
own points with strategy ``default``. Differences are arm less baseline, paired by scene and repeat;
repeats are averaged within a scene. Seconds include making the seeds and training. Between two
tests of a curve scores are interpolated linearly over seconds. Promise: an arm is compared over the
scenes that both have; if a curve ends before a time, its last score stands for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, NamedTuple, TypeAlias

from splatseed.bench.analysis.convergence import reach
from splatseed.bench.analysis.statistics import Difference, adjusted, over_scenes
from splatseed.bench.analysis.study import BASELINE, Cell as Runs, Study, Variant
from splatseed.bench.planning.records import RunResult
from splatseed.train.settings import StrategyName

Measure: TypeAlias = Callable[[RunResult], float | None]
Pair: TypeAlias = tuple[RunResult, RunResult]


class Arm(NamedTuple):
    """Seeds and a strategy."""

    strategy: StrategyName
    variant: Variant

    @property
    def label(self) -> str:
        """In a few words."""
        return f"{self.variant.label} + {self.strategy}"


@dataclass(frozen=True)
class Compared:
    """An arm compared with the baseline.

    Args:
        arm: The arm.
        scenes: The scenes that both have.
        runs: Pairs of runs behind the differences.
        psnr: Its mean PSNR in dB over scenes; likewise the other scores; None if unknown on some
            of the scenes.
        gain: Difference of PSNR, dB.
        covisible_gain: The same over co-visible pixels.
        ssim_gain: Difference of SSIM.
        lpips_gain: Difference of LPIPS; below 0 is better.
        gain_in_time: PSNR at the seconds at which the baseline ends, less the baseline's final
            PSNR, dB.
        reached: Pairs whose arm reaches the baseline's final PSNR.
        sooner: Mean logarithm of seconds to the baseline's final PSNR, relative to the baseline's
            total; None unless all reach it.
        num_gaussians: Mean number at the end.
        seeding: Mean seconds.
        training: Mean seconds.
    """

    arm: Arm
    scenes: tuple[str, ...]
    runs: int
    psnr: float
    covisible_psnr: float | None
    ssim: float
    lpips: float | None
    gain: Difference
    covisible_gain: Difference | None
    ssim_gain: Difference | None
    lpips_gain: Difference | None
    gain_in_time: Difference | None
    reached: int
    sooner: Difference | None
    num_gaussians: float
    seeding: float
    training: float


def baseline_of(study: Study) -> Arm | None:
    """The scene's own points with ``default``, or with the first strategy they were run with."""
    known = [s for s in study.strategies if any(study.cell(s, x, BASELINE) for x in study.scenes)]
    if not known:
        return None
    return Arm("default" if "default" in known else known[0], BASELINE)


def compared_arms(study: Study) -> tuple[Compared, ...]:
    """Every arm compared with the baseline, the one with the highest mean gain first.

    The p values of each kind of difference are adjusted together over the arms.

    Args:
        study: The study.
    """
    base = baseline_of(study)
    if base is None:
        return ()
    arms = [Arm(s, v) for s in study.strategies for v in (BASELINE, *study.variants_of(s))]
    compared = [each for arm in arms if (each := _compared(study, base, arm)) is not None]
    return tuple(sorted(_with_adjusted(compared, base), key=lambda each: -each.gain.mean))


def _compared(study: Study, base: Arm, arm: Arm) -> Compared | None:
    pairs = {
        scene: _pairs(study.cell(base.strategy, scene, base.variant),
                      study.cell(arm.strategy, scene, arm.variant))
        for scene in study.scenes
    }  # fmt: skip
    pairs = {scene: each for scene, each in pairs.items() if each}
    if not pairs:
        return None
    own = [[second for _, second in each] for each in pairs.values()]
    listed = list(pairs.values())
    seconds = _times(listed)
    gain = _difference(listed, lambda r: r.psnr)
    assert gain is not None  # noqa: S101  (PSNR is always known)
    return Compared(
        arm=arm,
        scenes=tuple(pairs),
        runs=sum(map(len, listed)),
        psnr=_mean(own, lambda r: r.psnr) or 0.0,
        covisible_psnr=_mean(own, lambda r: r.scores.covisible_psnr),
        ssim=_mean(own, lambda r: r.ssim) or 0.0,
        lpips=_mean(own, lambda r: r.lpips),
        gain=gain,
        covisible_gain=_difference(listed, lambda r: r.scores.covisible_psnr),
        ssim_gain=_difference(listed, lambda r: r.ssim),
        lpips_gain=_difference(listed, lambda r: r.lpips),
        gain_in_time=_in_time(listed),
        reached=sum(own is not None for scene in seconds for _, own in scene),
        sooner=_sooner(seconds),
        num_gaussians=_mean(own, lambda r: float(r.num_gaussians)) or 0.0,
        seeding=_mean(own, lambda r: r.upsample_seconds) or 0.0,
        training=_mean(own, lambda r: r.train_seconds) or 0.0,
    )


def _pairs(base: Runs, own: Runs) -> list[Pair]:
    return [(base[r], own[r]) for r in sorted(base.keys() & own.keys())]


def _mean(scenes: Sequence[Sequence[RunResult]], measure: Measure) -> float | None:
    """Mean over scenes of the means over repeats; None unless known for all."""
    values = [[measure(result) for result in runs] for runs in scenes]
    known = [[v for v in each if v is not None] for each in values]
    return fmean(map(fmean, known)) if all(known) else None


def _difference(scenes: Sequence[Sequence[Pair]], measure: Measure) -> Difference | None:
    """Mean difference; its error over scenes, or over the repeats of one."""
    differences = []
    for pairs in scenes:
        both = [(measure(base), measure(own)) for base, own in pairs]
        known = [own - base for base, own in both if base is not None and own is not None]
        if known:
            differences.append(known)
    return _over(differences) if len(differences) == len(scenes) else None


def _over(scenes: Sequence[Sequence[float]]) -> Difference:
    return over_scenes(scenes[0] if len(scenes) == 1 else [fmean(each) for each in scenes])


def psnr_at(result: RunResult, seconds: float) -> float | None:
    """A run's test PSNR ``seconds`` after it began to make seeds, dB.

    Args:
        result: The run.
        seconds: Of seeding and training.

    Returns:
        None before its first test; its last PSNR once it has ended.
    """
    times = [result.upsample_seconds + point.seconds for point in result.curve]
    if not times or seconds < times[0]:
        return None
    after = next((i for i, time in enumerate(times) if time > seconds), None)
    if after is None:
        return result.psnr
    low, high = result.curve[after - 1].psnr, result.curve[after].psnr
    span = times[after] - times[after - 1]
    return low + (seconds - times[after - 1]) / span * (high - low) if span > 0 else high


def _in_time(scenes: Sequence[Sequence[Pair]]) -> Difference | None:
    """The arm's lead when the baseline ends; None if an arm has no test by then."""
    leads = []
    for pairs in scenes:
        at = [(base.psnr, psnr_at(own, base.seconds)) for base, own in pairs]
        known = [own - base for base, own in at if own is not None]
        if len(known) < len(at):
            return None
        leads.append(known)
    return _over(leads)


def _times(scenes: Sequence[Sequence[Pair]]) -> list[list[tuple[float, float | None]]]:
    """The baseline's total seconds, and the arm's to the baseline's final PSNR, by scene."""
    return [
        [(base.seconds, _seconds_to(own, base.psnr)) for base, own in pairs] for pairs in scenes
    ]


def _seconds_to(own: RunResult, target: float) -> float | None:
    """When a run reaches that PSNR, even if the run is the baseline itself."""
    reached = reach(own, target)
    if reached is not None:
        return reached.seconds
    return own.seconds if own.psnr >= target else None


def _sooner(scenes: Sequence[Sequence[tuple[float, float | None]]]) -> Difference | None:
    logs = [
        [math.log(max(own, 1e-9) / max(base, 1e-9)) for base, own in each if own is not None]
        for each in scenes
    ]
    complete = all(own is not None for each in scenes for _, own in each)
    return _over(logs) if complete else None


def _with_adjusted(compared: Sequence[Compared], base: Arm) -> list[Compared]:
    """The differences with their p values adjusted over all arms except the baseline itself."""
    others = [each for each in compared if each.arm != base]
    kinds = ("gain", "covisible_gain", "ssim_gain", "lpips_gain", "gain_in_time", "sooner")
    columns = {kind: adjusted([getattr(each, kind) for each in others]) for kind in kinds}
    changed = []
    for i, each in enumerate(others):
        known: dict[str, Any] = {kind: column[i] for kind, column in columns.items()}
        changed.append(replace(each, **known))
    return [*(each for each in compared if each.arm == base), *changed]
