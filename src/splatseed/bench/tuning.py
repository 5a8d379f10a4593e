"""Tuning one scene by successive halving: many arms in short runs, the best of them in longer ones.

Notation: a *rung* trains some arms for a number of steps; the best go on to the next rung, which
has twice the steps. The *baseline* (the scene's own points with ``default``) is in every rung.
Promise: arms are ranked by validation views only, of a scene that lists training views alone: the
photographs of test views are never opened; the verdict rests on the last finished rung, paired by
view and repeat. After Jamieson and Talwalkar (2016), but every rung trains from the start, as a
run's schedule depends on its length.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import fmean

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
_OVERTIME = 1.1
"""By how much the estimated time may exceed the time given."""
_LEAST_VIEWS = 4
"""Fewest training views of a scene: some to train on, and at least one to validate on."""
Results = Mapping[Arm, Mapping[int, RunResult]]
"""Results by arm and repeat."""


@dataclass(frozen=True)
class Rung:
    """A rung: steps of each run, number of arms with the baseline, runs of each arm."""

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
    return (arm.method, arm.strategy) == (SFM, "default")


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

    Raises:
        ParameterError: Not even the shortest sensible rungs fit.
    """

    def rungs(steps: int) -> tuple[Rung, ...]:
        counts = [min(max(2, round(part * num_arms)), num_arms) for part in KEPT]
        repeats = [1] * (len(KEPT) - 1) + [LAST_REPEATS]
        pairs = enumerate(zip(counts, repeats, strict=True))
        return tuple(Rung(steps << i, arms, runs) for i, (arms, runs) in pairs)

    low = max(LEAST_STEPS, least_steps)
    high = max(most_steps >> (len(KEPT) - 1), low)
    while high - low > max(LEAST_STEPS // 10, 1):
        middle = (low + high) // 2
        low, high = (middle, high) if cost(rungs(middle)) <= seconds else (low, middle)
    if (needed := cost(rungs(low))) > _OVERTIME * seconds:
        raise ParameterError(
            f"--minutes {math.ceil(needed / 60)} or more: the shortest runs in which all arms come "
            "to one number of Gaussians take that long",
            found=f"--minutes {seconds / 60:g}",
            fix="Give it more time, or name fewer --methods or --strategies.",
        )
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
    """The verdict of a rung; None without a run of the baseline, or of another arm.

    Args:
        results: Results of the rung. Of a round that was stopped, which has more repeats of some
            arms, those count that all have.
        steps: Steps of its runs.
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
    if not shared:
        return None
    gains = np.stack([_of_views(results[winner][r]) - _of_views(results[base][r]) for r in shared])
    gains = gains[:, np.isfinite(gains).all(axis=0)]
    if not gains.size:
        return None
    gain = over_views_and_repeats(gains)
    return Verdict(winner, gain, steps, gains.shape[1], len(shared), tuple(ranking))


def _of_views(result: RunResult) -> np.ndarray:
    scores = {view.name: view.psnr for view in result.scores.per_image}
    return np.array([scores[name] for name in sorted(scores)])


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


def most_grown(num_points: int, steps: int) -> int:
    """The most Gaussians that ``grow`` is sure to reach from so many points in so many steps."""
    return max(2, math.floor(num_points * growth_within(steps)))


def steps_to_grow(factor: float) -> int:
    """The fewest steps in which ``grow`` multiplies its Gaussians by a factor.

    A factor beyond what a full run reaches counts as that.
    """
    within = min(factor, growth_within(FULL_RUN))
    return next(steps for steps in count(10, 10) if growth_within(steps) >= within)


def make_validation_scene(scene_path: Path, target: Path, test_every: int = 8) -> Path:
    """Write a scene's training views as a scene of their own, unless that exists.

    Its runs are scored on every eighth of them; photographs are linked.

    Args:
        scene_path: The scene.
        target: The folder to write.
        test_every: Every n-th view is kept for testing.

    Returns:
        ``target``.

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
    if len(train) < _LEAST_VIEWS:
        raise SceneNotFoundError(
            f"at least {_LEAST_VIEWS} training views in {scene_path}, to hold some of them out",
            found=f"{len(train)}",
            fix="Tune a scene with more photographs.",
        )
    alone = scene.replace(images=train, listed=None)
    write_scene(alone, target, format="colmap", provenance={"command": "tune"})
    for folder, names in ((target, ROOT_LISTS), (target / "sparse" / "0", MODEL_LISTS)):
        for name in names:  # of the whole scene's views
            (folder / name).unlink(missing_ok=True)
    return target
