"""How soon a run becomes as good as the baseline's final result.

Notation: a run *reaches* the target when its test PSNR first equals the final PSNR of the
baseline's run on the same scene with the same repeat; between two tests of the curve the PSNR is
interpolated linearly. Seconds include training and making the seeds. Promise: runs that never reach
it are counted, not silently dropped: a mean over the others would flatter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from splatseed.bench.analysis.statistics import Difference, adjusted, over_scenes
from splatseed.bench.analysis.study import BASELINE, Study, Variant
from splatseed.bench.analysis.tables import Cell, Table, number, words
from splatseed.bench.planning.records import RunResult
from splatseed.scores import CurvePoint
from splatseed.train.settings import StrategyName


@dataclass(frozen=True)
class Reached:
    """When the target was reached: steps done, and seconds with upsampling."""

    steps: float
    seconds: float


@dataclass(frozen=True)
class Speed:
    """How soon a variant reaches the target, and the baseline's own first time.

    Args:
        pairs: Pairs of runs that can be compared.
        reached: Pairs whose variant reaches the target.
        steps: Mean steps over scenes, of the runs that reach it; None if there are none.
        seconds: The same in seconds.
        base_steps: The baseline's steps to its own final PSNR.
        base_seconds: The same in seconds.
        log_steps: Mean difference of the logarithm of steps, if all reach it; else None.
        log_seconds: The same for seconds.
    """

    pairs: int
    reached: int
    steps: float | None
    seconds: float | None
    base_steps: float
    base_seconds: float
    log_steps: Difference | None
    log_seconds: Difference | None


def reach(result: RunResult, target: float) -> Reached | None:
    """When a run's test PSNR first is at least ``target``.

    Args:
        result: The run.
        target: PSNR in dB.

    Returns:
        None if it never is. A run above it at its first test has reached it there at the latest.
    """
    before: CurvePoint | None = None
    for point in result.curve:
        if point.psnr >= target:
            part = 1.0 if before is None else _part(before.psnr, point.psnr, target)
            start = point if before is None else before
            steps = start.step + part * (point.step - start.step)
            seconds = start.seconds + part * (point.seconds - start.seconds)
            return Reached(steps, seconds + result.upsample_seconds)
        before = point
    return None


def _part(low: float, high: float, target: float) -> float:
    """The fraction of the way from ``low`` to ``high`` at which the target lies."""
    return 1.0 if math.isinf(high) or not high > low else (target - low) / (high - low)


def speed(study: Study, strategy: StrategyName, variant: Variant) -> Speed | None:
    """How soon a variant is as good as the baseline's final result.

    Args:
        study: The study.
        strategy: The strategy.
        variant: The variant.

    Returns:
        None if no pair of runs has curves.
    """
    scenes = [_times(study, strategy, scene, variant) for scene in study.scenes_of(strategy)]
    scenes = [each for each in scenes if each]
    if not scenes:
        return None
    pairs = [pair for scene in scenes for pair in scene]
    reached = [[(base, own) for base, own in scene if own is not None] for scene in scenes]
    known = [each for each in reached if each]
    everywhere = all(own is not None for _, own in pairs)
    return Speed(
        pairs=len(pairs),
        reached=sum(map(len, reached)),
        steps=_mean([[own.steps for _, own in scene] for scene in known]),
        seconds=_mean([[own.seconds for _, own in scene] for scene in known]),
        base_steps=fmean(fmean(base.steps for base, _ in scene) for scene in scenes),
        base_seconds=fmean(fmean(base.seconds for base, _ in scene) for scene in scenes),
        log_steps=_log([[(b.steps, o.steps) for b, o in s] for s in known]) if everywhere else None,
        log_seconds=_log([[(b.seconds, o.seconds) for b, o in s] for s in known])
        if everywhere
        else None,
    )


def _times(
    study: Study, strategy: StrategyName, scene: str, variant: Variant
) -> list[tuple[Reached, Reached | None]]:
    """When baseline and variant reach the baseline's last PSNR, for each repeat that has both."""
    times = []
    for base, other in study.pairs(strategy, scene, variant):
        if not base.curve or not other.curve or not math.isfinite(base.curve[-1].psnr):
            continue
        first = reach(base, base.curve[-1].psnr)
        if first is not None:
            times.append((first, reach(other, base.curve[-1].psnr)))
    return times


def _mean(scenes: Sequence[Sequence[float]]) -> float | None:
    return fmean(map(fmean, scenes)) if scenes else None


def _log(scenes: Sequence[Sequence[tuple[float, float]]]) -> Difference:
    """Mean over scenes of log(own / base), with its error over scenes, or over repeats of one."""
    logs = [[math.log(max(own, 1e-9) / max(base, 1e-9)) for base, own in scene] for scene in scenes]
    return over_scenes(logs[0] if len(logs) == 1 else [fmean(each) for each in logs])


def convergence_table(study: Study, strategy: StrategyName) -> Table:
    """Steps and seconds to the baseline's last PSNR, by variant.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    variants = [
        (variant, timing)
        for variant in study.variants_of(strategy)
        if (timing := speed(study, strategy, variant)) is not None
    ]
    steps = adjusted([timing.log_steps for _, timing in variants])
    seconds = adjusted([timing.log_seconds for _, timing in variants])
    rows = [
        _row(variant, timing, steps[i], seconds[i]) for i, (variant, timing) in enumerate(variants)
    ]
    return Table(
        f"convergence_{strategy}",
        f"Steps and seconds to {BASELINE.label}'s last PSNR, strategy {strategy}",
        ("method", "reached", "steps", "sfm's steps", "steps ratio", "seconds", "sfm's seconds",
         "seconds ratio"),
        tuple(rows),
        (
            NOTE,
            f"{study.description}.",
        ),
    )  # fmt: skip


NOTE = (
    "Where a run's test PSNR first is at least the last one of the sfm run of the same scene and "
    "repeat; seconds with upsampling. 'sfm' reaches its own last PSNR earlier where its curve is "
    "not rising at the end. Means are over the runs that reach it, within scenes first; ratios "
    "are geometric means, below 1 is sooner, given only where all runs reach it. ~: a ratio "
    "within noise (t-test over scenes, or over repeats where there is one scene; Holm-corrected "
    "over the column)."
)


def _row(
    variant: Variant, timing: Speed, steps: Difference | None, seconds: Difference | None
) -> tuple[Cell, ...]:
    return (
        words(variant.label),
        words(f"{timing.reached} of {timing.pairs}"),
        number(timing.steps, 0),
        number(timing.base_steps, 0),
        _ratio(steps),
        number(timing.seconds, 1),
        number(timing.base_seconds, 1),
        _ratio(seconds),
    )


def _ratio(log: Difference | None) -> Cell:
    if log is None:
        return Cell()
    mark = "~" if log.verdict == "within noise" else ""
    text = "(no spread)" if math.isnan(log.se) else ""
    return Cell(math.exp(log.mean), digits=2, mark=mark, text=text)
