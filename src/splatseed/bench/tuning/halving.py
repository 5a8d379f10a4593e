"""Successive halving: many arms in short runs, the best of them in longer ones.

Notation: a *rung* trains some arms for a number of steps; the best go on to the next rung, which
has twice the steps. The *baseline* (the scene's own points with ``default``) is in every rung.
Promise: arms are ranked by validation views only; the verdict rests on the last finished rung,
paired by view and repeat. After Jamieson and Talwalkar (2016), but every rung trains from the
start, as a run's schedule depends on its length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from splatseed.bench.analysis.statistics import Difference, over_views_and_repeats
from splatseed.bench.planning.records import SFM, Arm, RunResult
from splatseed.errors import ParameterError

BASELINE = (SFM, "default")
"""Method and strategy of the baseline."""
KEPT = (1.0, 1 / 3, 1 / 6)
"""Share of the arms in each rung; the last rung repeats its runs."""
LAST_REPEATS = 2
LEAST_STEPS = 100
MINUTE = 60.0
OVERTIME = 1.1
"""By how much the estimated time may exceed the time given."""
Results = Mapping[Arm, Mapping[int, RunResult]]
"""Results by arm and repeat."""


@dataclass(frozen=True)
class Rung:
    """A rung.

    Args:
        steps: Steps of each run.
        arms: Number of arms, with the baseline.
        repeats: Runs of each arm.
    """

    steps: int
    arms: int
    repeats: int


@dataclass(frozen=True)
class Verdict:
    """The verdict of the last rung.

    Args:
        winner: The arm with the highest mean PSNR.
        gain: Its PSNR minus the baseline's, dB: mean and standard error over validation views and
            repeats.
        steps: Steps of its runs.
        views: Number of validation views.
        repeats: Runs of each arm.
        ranking: All arms of that rung with their mean PSNR in dB, the best first.
    """

    winner: Arm
    gain: Difference
    steps: int
    views: int
    repeats: int
    ranking: tuple[tuple[Arm, float], ...]


def is_baseline(arm: Arm) -> bool:
    """Whether an arm is the baseline."""
    return (arm.method, arm.strategy) == BASELINE


def plan_rungs(
    num_arms: int,
    seconds: float,
    most_steps: int,
    cost: Callable[[Sequence[Rung]], float],
    least_steps: int = 0,
) -> tuple[Rung, ...]:
    """The longest rungs that fit into a time.

    Args:
        num_arms: Number of arms.
        seconds: The time.
        most_steps: Most steps of the last rung.
        cost: Estimates the seconds of some rungs.
        least_steps: Fewest steps of the first rung.

    Returns:
        The shortest rungs, if not even these fit.
    """

    def rungs(steps: int) -> tuple[Rung, ...]:
        counts = [max(2, round(part * num_arms)) for part in KEPT]
        last = len(KEPT) - 1
        return tuple(
            Rung(steps << i, min(count, num_arms), LAST_REPEATS if i == last else 1)
            for i, count in enumerate(counts)
        )

    low = max(LEAST_STEPS, least_steps)
    high = max(most_steps >> (len(KEPT) - 1), low)
    while high - low > max(LEAST_STEPS // 10, 1):
        middle = (low + high) // 2
        low, high = (middle, high) if cost(rungs(middle)) <= seconds else (low, middle)
    return rungs(low)


def check_time(needed: float, seconds: float) -> None:
    """Refuse a time in which not even the shortest sensible rungs end.

    Args:
        needed: Estimated seconds of the planned rungs.
        seconds: The time given.

    Raises:
        ParameterError: They take longer.
    """
    if needed > OVERTIME * seconds:
        raise ParameterError(
            f"--minutes {math.ceil(needed / MINUTE)} or more: the shortest runs in which all arms "
            "come to one number of Gaussians take that long",
            found=f"--minutes {seconds / MINUTE:g}",
            fix="Give it more time, or name fewer --methods or --strategies.",
        )


def best_arms(results: Results, count: int) -> tuple[Arm, ...]:
    """The arms with the highest mean PSNR; always with the baseline.

    Args:
        results: Results of a rung.
        count: Number of arms, at least 2.
    """
    ranked = [arm for arm, _ in _ranking(results)]
    chosen = ranked[:count]
    base = [arm for arm in ranked if is_baseline(arm)]
    return tuple(chosen if set(base) <= set(chosen) else [*chosen[: count - 1], *base])


def _ranking(results: Results) -> list[tuple[Arm, float]]:
    means = [(arm, fmean(r.psnr for r in runs.values())) for arm, runs in results.items() if runs]
    return sorted(means, key=lambda pair: -pair[1])


def verdict(results: Results, steps: int) -> Verdict | None:
    """The verdict of a rung; None without a run of the baseline, or of another arm.

    Args:
        results: Results of the rung.
        steps: Steps of its runs.
    """
    ranking = _ranking(_of_common_repeats(results))
    base = next((arm for arm, _ in ranking if is_baseline(arm)), None)
    if base is None or len(ranking) < 2:
        return None
    winner = ranking[0][0]
    gains = _by_view(results[base], results[winner])
    if not gains.size:
        return None
    return Verdict(
        winner,
        over_views_and_repeats(gains),
        steps,
        gains.shape[1],
        len(results[winner].keys() & results[base].keys()),
        tuple(ranking),
    )


def _of_common_repeats(results: Results) -> Results:
    """The results of repeats that all arms have: a round that was stopped has more of some arms."""
    done = [set(runs) for runs in results.values() if runs]
    common = set.intersection(*done) if done else set()
    if not common:
        return results
    return {arm: {r: runs[r] for r in common & runs.keys()} for arm, runs in results.items()}


def _by_view(base: Mapping[int, RunResult], own: Mapping[int, RunResult]) -> np.ndarray:
    """PSNR differences by common repeat and view, finite in all of them, [R, V]."""
    shared = sorted(base.keys() & own.keys())
    if not shared:
        return np.zeros((0, 0))
    gains = np.stack([_of_views(own[r]) - _of_views(base[r]) for r in shared])
    return np.asarray(gains[:, np.isfinite(gains).all(axis=0)])


def _of_views(result: RunResult) -> np.ndarray:
    scores = {view.name: view.psnr for view in result.scores.per_image}
    values = np.array([scores[name] for name in sorted(scores)])
    return np.where(np.isfinite(values), values, math.nan)
