"""Tuning one scene by successive halving: many arms in short runs, the best of them in longer ones.

A *rung* trains some arms; the best go on to the next, of twice the steps, which train from the
start (Jamieson and Talwalkar 2016, but for that). Arms are ranked by validation views only, of a
scene without the test views; the verdict rests on the last finished rung, paired by view.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np

from splatseed.bench.plan import SFM, Arm, RunResult
from splatseed.bench.statistics import Difference, over_views_and_repeats
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io import load_originals, write_scene
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS
from splatseed.train.schedule import FULL_RUN, make_schedule
from splatseed.views.view import check_lens

KEPT = (1.0, 1 / 3, 1 / 6)
"""Share of the arms in each rung; the last rung repeats its runs."""
LAST_REPEATS = 2
LEAST_STEPS = 100
_STEP = 10
"""Steps of a first rung are tried in multiples of this."""
_OVERTIME = 1.1
"""By how much the estimated time may exceed the time given."""
LEAST_VIEWS = 4
"""Fewest training views of a scene: some to train on, and at least one to validate on."""
Results = Mapping[Arm, Mapping[int, RunResult]]
"""Results by arm and repeat."""


@dataclass(frozen=True)
class Rung:
    """A rung: steps of each run, number of arms with the baseline, runs of each arm."""

    steps: int
    arms: int
    repeats: int


class Verdict(NamedTuple):
    """The verdict of the last rung.

    ``winner`` is the arm with the highest mean PSNR, and ``gain`` what it gains over the baseline,
    dB: mean and standard error over ``views`` validation views and ``repeats``; ``ranking`` has all
    arms with their mean PSNR in dB, the best first.
    """

    winner: Arm
    gain: Difference
    steps: int
    views: int
    repeats: int
    ranking: tuple[tuple[Arm, float], ...]


def is_baseline(arm: Arm) -> bool:
    """Whether an arm is the baseline."""
    return (arm.method, arm.strategy) == (SFM, "default")


def plan_rungs(
    num_arms: int,
    seconds: float,
    most_steps: int,
    cost: Callable[[Sequence[Rung]], float],
    least_steps: int = 0,
) -> tuple[Rung, ...]:
    """The longest rungs that fit into a time, by an estimate of their cost in seconds.

    The last has at most ``most_steps``, the first at least ``least_steps``.

    Raises:
        ParameterError: Not even the shortest sensible rungs fit.
    """
    counts = [min(max(2, round(part * num_arms)), num_arms) for part in KEPT]
    repeats = [1] * (len(KEPT) - 1) + [LAST_REPEATS]

    def rungs(steps: int) -> tuple[Rung, ...]:
        pairs = enumerate(zip(counts, repeats, strict=True))
        return tuple(Rung(steps << i, arms, runs) for i, (arms, runs) in pairs)

    low = max(LEAST_STEPS, least_steps)
    longer = range(low, (most_steps >> (len(KEPT) - 1)) + 1, _STEP)
    fitting = bisect_right(longer, seconds, key=lambda steps: cost(rungs(steps)))
    if fitting:
        return rungs(longer[fitting - 1])
    if (needed := cost(rungs(low))) > _OVERTIME * seconds:
        least = f"--minutes {math.ceil(needed / 60)} or more, as fewer steps cannot be compared"
        fix = "Give it more time, or name fewer --methods or --strategies."
        raise ParameterError(least, found=f"--minutes {seconds / 60:g}", fix=fix)
    return rungs(low)


def best_arms(results: Results, number: int) -> tuple[Arm, ...]:
    """The arms of a rung with the highest mean PSNR, at least 2; always with the baseline."""
    ranked = [arm for arm, _ in _ranking(results)]
    chosen = ranked[:number]
    base = [arm for arm in ranked if is_baseline(arm)]
    return tuple(chosen if set(base) <= set(chosen) else [*chosen[: number - 1], *base])


def _ranking(results: Results) -> list[tuple[Arm, float]]:
    means = [(arm, fmean(r.psnr for r in runs.values())) for arm, runs in results.items() if runs]
    return sorted(means, key=lambda pair: -pair[1])


def verdict(results: Results, steps: int) -> Verdict | None:
    """The verdict of a rung of so many steps; None without a run of the baseline, or of another.

    Of a round that was stopped, which has more repeats of some arms, those count that all have.
    """
    done = [set(runs) for runs in results.values() if runs]
    common = set.intersection(*done) if done else set()
    if common:
        results = {arm: {r: runs[r] for r in common & runs.keys()} for arm, runs in results.items()}
    ranking = _ranking(results)
    base = next((arm for arm, _ in ranking if is_baseline(arm)), None)
    if base is None or len(ranking) < 2:
        return None
    winner = ranking[0][0]
    shared = sorted(results[base].keys() & results[winner].keys())
    gains = np.array([_of_views(results[winner][r]) - _of_views(results[base][r]) for r in shared])
    gains = gains[:, np.isfinite(gains).all(axis=0)] if shared else gains
    if not gains.size:
        return None
    gain = over_views_and_repeats(gains)
    return Verdict(winner, gain, steps, gains.shape[1], len(shared), tuple(ranking))


def _of_views(result: RunResult) -> np.ndarray:
    return np.array([view.psnr for view in sorted(result.scores.per_image, key=lambda v: v.name)])


def growth_within(steps: int) -> float:
    """The factor by which ``grow`` is sure to multiply its Gaussians in a run of so many steps.

    It adds at most ``FASTEST`` of what there is in a round, and a short run has few rounds: from
    few points it would end below the budget, and arms of unequal numbers say nothing.
    """
    from splatseed.train.growing import FASTEST  # noqa: PLC0415  (imports PyTorch)

    schedule = make_schedule("grow", steps, as_3dgs=False)
    rounds = schedule.refine_stop // schedule.refine_every
    # One round makes up for the Gaussians that are removed.
    return float((1 + FASTEST) ** max(0, rounds - 1))


def steps_to_grow(factor: float) -> int:
    """The fewest steps in which ``grow`` multiplies its Gaussians by a factor.

    A factor beyond what a full run reaches counts as that.
    """
    within = min(factor, growth_within(FULL_RUN))
    return next(steps for steps in count(10, 10) if growth_within(steps) >= within)


def make_validation_scene(scene_path: Path, target: Path, test_every: int = 8) -> Path:
    """Write a scene's training views as a scene of their own, unless that exists; ``target``.

    Its runs are scored on every eighth of them; photographs are linked.

    Raises:
        SceneNotFoundError: There is no scene, or it has too few images.
        SceneFormatError: One of its files breaks its format, or a lens has distortion.
        OutputError: The folder cannot be written.
    """
    if target.is_dir():
        return target
    scene = load_originals(scene_path)
    for image in scene.images:
        check_lens(image, scene_path)
    train, _ = scene.split(test_every)
    if len(train) < LEAST_VIEWS:
        least = f"at least {LEAST_VIEWS} training views in {scene_path}, to hold some of them out"
        raise SceneNotFoundError(least, found=f"{len(train)}", fix="Tune a scene with more.")
    alone = scene.replace(images=train, listed=None)
    write_scene(alone, target, format="colmap", provenance={"command": "tune"})
    for folder, names in ((target, ROOT_LISTS), (target / "sparse" / "0", MODEL_LISTS)):
        for name in names:  # of the whole scene's views
            (folder / name).unlink(missing_ok=True)
    return target
