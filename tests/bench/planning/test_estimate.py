"""Estimates: in proportion to the work, and by what has been measured where something has."""

from __future__ import annotations

import dataclasses

import pytest

from splatseed.bench.planning.estimate import Estimator
from splatseed.bench.planning.plan import Plan, plan_runs
from splatseed.bench.planning.records import SFM, Arm, RunResult, RunRow, RunSpec
from splatseed.bench.planning.scenes import SceneFacts
from splatseed.scores import EvalResult, ViewScore
from splatseed.train.settings import TrainSettings

FACTS = SceneFacts("room", "", "ab12", num_points=10_000, num_images=80, pixels=800 * 600,
                    long_side=800)  # fmt: skip
TRAINING = TrainSettings(max_steps=1000, backend="cpu")
SPEC = RunSpec("room", "ab12", Arm("mls", "default", 8, "none"), repeat=0, training=TRAINING)
SCORES = EvalResult((ViewScore("a.png", 21.5, 0.8, None, 0.01),), num_gaussians=80_000)
RESULT = RunResult(SCORES, (), 80_000, 0.2, 500.0, 10**9, "CPU")


def _row(spec=SPEC, seconds=530.0, **changes):
    if "num_gaussians" in changes:
        changes["scores"] = dataclasses.replace(SCORES, num_gaussians=changes.pop("num_gaussians"))
    result = dataclasses.replace(RESULT, **changes)
    return RunRow(spec, "done", result, started=1000.0, finished=1000.0 + seconds)


def _spec(**changes):
    own = {name: changes.pop(name) for name in ("arm", "scene_digest") if name in changes}
    return dataclasses.replace(SPEC, training=dataclasses.replace(TRAINING, **changes), **own)


def test_more_work_takes_longer():
    estimator = Estimator([FACTS], [])
    base = estimator.seconds(SPEC)
    sfm = Arm(SFM, "default", 1, "none")
    for less in (_spec(max_steps=500), _spec(data_factor=2), _spec(arm=sfm), _spec(cap_max=9)):
        assert estimator.seconds(less) < base
    assert estimator.seconds(_spec(arm=Arm("mls", "default", 8, "default"))) > base
    assert Estimator([FACTS], [], threads=8).seconds(SPEC) < base
    assert estimator.seconds(_spec(backend="cuda")) < base
    assert estimator.disk(SPEC, models=True) - estimator.disk(SPEC, models=False) == pytest.approx(
        80_000 * 59 * 4
    )
    assert estimator.checkpoint(SPEC) == pytest.approx(3 * 80_000 * 59 * 4)


def test_a_run_like_one_that_is_done_takes_as_long():
    estimator = Estimator([FACTS], [_row()])
    assert estimator.num_measured == 1
    assert estimator.seconds(SPEC) == pytest.approx(530)
    assert estimator.seconds(_spec(max_steps=2000)) == pytest.approx(1030)


def test_one_slow_run_does_not_spoil_the_estimate():
    rows = [_row(seconds=530.0), _row(seconds=540.0), _row(train_seconds=9000.0, seconds=9030.0)]
    assert Estimator([FACTS], rows).seconds(SPEC) == pytest.approx(530)


@pytest.mark.parametrize("strategy", ["default", "mcmc", "none"])
def test_conventions_do_not_change_what_is_guessed_of_growth(strategy):
    estimator = Estimator([FACTS], [])
    own, in_3dgs = (Arm(SFM, "default", 1, name) for name in (strategy, f"{strategy}-3dgs"))
    assert estimator.checkpoint(_spec(arm=own)) == estimator.checkpoint(_spec(arm=in_3dgs))


def test_growth_is_learnt_by_strategy_and_ratio():
    arm = Arm("mls", "default", 8, "default")
    grown = _row(_spec(arm=arm), num_gaussians=400_000)
    estimator = Estimator([FACTS], [grown])
    assert estimator.checkpoint(_spec(arm=arm)) == pytest.approx(3 * 400_000 * 59 * 4)
    assert estimator.checkpoint(SPEC) == pytest.approx(3 * 80_000 * 59 * 4)
    sfm = Arm(SFM, "default", 1, "default")  # as long as nothing better is known
    assert estimator.checkpoint(_spec(arm=sfm)) == pytest.approx(3 * 50_000 * 59 * 4)
    few = _row(_spec(arm=sfm), num_seeds=10_000, num_gaussians=200_000)
    estimator = Estimator([FACTS], [grown, few])
    assert estimator.checkpoint(_spec(arm=sfm)) == pytest.approx(3 * 200_000 * 59 * 4)
    assert estimator.checkpoint(_spec(arm=arm)) == pytest.approx(3 * 400_000 * 59 * 4)
    capped = _spec(arm=arm, cap_max=100_000)
    assert estimator.checkpoint(capped) == pytest.approx(3 * 100_000 * 59 * 4)


def test_runs_of_scenes_that_are_not_known_tell_nothing():
    elsewhere = _row(_spec(scene_digest="other"))
    assert Estimator([FACTS], [elsewhere, RunRow(SPEC)]).num_measured == 0


def _world(spec, scene):
    """What a run takes on a machine of its own habits: half as fast, slow to seed."""
    gaussians = spec.settings.cap
    pace = {"default": 1.0, "grow": 1.3, "mcmc": 1.6}[spec.arm.strategy]
    train = 2.0 * pace * 1500 * (5e-3 + 0.3e-6 * gaussians + 0.05e-6 * scene.pixels / 4)
    seeding = {"sfm": 0.1, "mls": 2.0, "auto": 1.9 * scene.num_images}[spec.arm.method]
    if spec.arm.strategy == "grow" and spec.arm.method != "auto":  # which has found depth already
        train += 1.9 * scene.num_images
    return train, seeding, 12.0 + 0.3 * scene.num_images / 8


def test_after_the_first_runs_an_estimate_is_within_30_percent():
    """Seeding included: one run of each method, scene and strategy, not of each combination."""
    scenes = [
        SceneFacts("fern", "", "a", 6000, 20, 800 * 600, long_side=800),
        SceneFacts("fox", "", "b", 13_000, 50, 449 * 800, long_side=800),
        SceneFacts("bonsai", "", "c", 1_000, 292, 800 * 533, long_side=800),
    ]
    plan = Plan(
        methods=("sfm", "mls", "auto"), ratios=(), budgets=("0.25rho",),
        strategies=("default", "grow", "mcmc"), repeats=1, long_side=400,
        training=TrainSettings(max_steps=1500),
    )  # fmt: skip
    runs = plan_runs(plan, scenes, "cpu", "1")
    facts = {scene.digest: scene for scene in scenes}
    rows = []
    for spec in runs[::4]:
        train, seeding, around = _world(spec, facts[spec.scene_digest])
        scores = dataclasses.replace(SCORES, num_gaussians=spec.settings.cap)
        made = dataclasses.replace(
            RESULT, scores=scores, num_seeds=spec.most_seeds, train_seconds=train,
            upsample_seconds=seeding,
        )  # fmt: skip
        rows.append(RunRow(spec, "done", made, finished=train + seeding + around, started=0.0))
    done = {row.spec.key for row in rows}
    estimator = Estimator(scenes, rows)
    left = [spec for spec in runs if spec.key not in done]
    said = sum(estimator.seconds(spec) for spec in left)
    actual = sum(sum(_world(spec, facts[spec.scene_digest])) for spec in left)
    assert said == pytest.approx(actual, rel=0.3)


def test_runs_that_take_over_anothers_training_take_no_time_for_it():
    full = dataclasses.replace(
        _spec(cap_max=5000), arm=Arm("mls", "default", 0, "none", budget="5000")
    )
    estimator = Estimator([FACTS], [])
    assert estimator.is_twin(full)
    assert estimator.seconds(full) < 0.1 * estimator.seconds(_spec(cap_max=5000))
    roomy = dataclasses.replace(full, training=dataclasses.replace(full.training, cap_max=50_000))
    assert not estimator.is_twin(roomy)


def test_what_runs_share_takes_time_once():
    scene = SceneFacts("fern", "", "a", 6000, 20, 800 * 600, long_side=800)
    plan = Plan(
        methods=("sfm", "stereo"), ratios=(), budgets=("0.25rho", "0.5rho"), repeats=1,
        training=TrainSettings(max_steps=100),
    )  # fmt: skip
    runs = plan_runs(plan, [scene], "cpu", "1")
    estimator = Estimator([scene], [])
    together = estimator.of_all(runs)
    alone = {run.key: estimator.seconds(run) for run in runs}
    first, second = (run.key for run in runs if run.arm.method == "stereo")
    assert together[first] == alone[first]
    assert together[second] < 0.7 * alone[second]
    assert all(together[run.key] == alone[run.key] for run in runs if run.arm.method == "sfm")
