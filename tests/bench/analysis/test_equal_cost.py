"""Arms of any strategy beside one baseline: gains, seconds, and what is said of them."""

from __future__ import annotations

import dataclasses

import pytest

from splatseed.bench.analysis.arms.compared import baseline_of, compared_arms, psnr_at
from splatseed.bench.analysis.arms.tables import (
    _in_time,
    answer_at_equal_cost,
    arm_table,
    scene_arm_table,
    seconds_table,
    unequal_numbers,
)
from splatseed.bench.analysis.study import studies
from splatseed.bench.analysis.tables import to_markdown
from splatseed.bench.planning.records import RunRow

from ..planted import result, rows


def _study(noise=0.02, plain=5000, **changes):
    """Two strategies under one budget, of which ``sfm`` makes ``plain``: ``grow`` has 0.3 dB more,
    its seeds take 4 s."""
    finished = []
    for row in rows(strategies=("default", "grow"), noise=noise, seed=3, **changes):
        arm = dataclasses.replace(row.spec.arm, budget="5000", ratio=row.spec.arm.ratio)
        run = dataclasses.replace(row.spec, arm=arm)
        more = 0.3 if arm.strategy == "grow" else 0.0
        seconds, count = (0.0, plain) if arm.method == "sfm" else (4.0, 5000)
        made = result(row.result.psnr + more, upsample_seconds=seconds, num_gaussians=count)
        finished.append(RunRow(run, "done", made, started=0.0, finished=25.0))
    (study,) = studies(finished)
    return study


def test_every_arm_stands_beside_one_baseline():
    study = _study()
    base = baseline_of(study)
    assert base.label == "sfm + default"
    by_label = {each.arm.label: each for each in compared_arms(study)}
    assert len(by_label) == 10
    # levels differ by strategy in what is planted, so only gains within one are known
    within = by_label["mls 8x + default"]
    assert within.gain.mean == pytest.approx(0.5, abs=0.05)
    assert within.gain.verdict == "better"
    assert within.covisible_gain.mean == pytest.approx(within.gain.mean)
    assert (within.runs, within.scenes) == (12, study.scenes)
    assert within.num_gaussians == 5000
    assert by_label["random 8x + default"].gain.mean == pytest.approx(-0.4, abs=0.05)
    assert [each.gain.mean for each in compared_arms(study)] == sorted(
        (each.gain.mean for each in compared_arms(study)), reverse=True
    )


def test_time_counts_seeding():
    study = _study(noise=0.0)
    by_label = {each.arm.label: each for each in compared_arms(study)}
    base = by_label["sfm + default"]
    assert base.sooner.mean == pytest.approx(0.0)
    assert base.gain_in_time.mean == pytest.approx(0.0)
    slower = by_label["mls 8x + default"]
    assert slower.seeding == 4.0
    assert slower.gain_in_time.mean < slower.gain.mean
    assert slower.reached == slower.runs


def test_a_loss_in_time_that_may_be_chance_is_called_so():
    base = compared_arms(_study())[0].arm
    best = compared_arms(_study())[-1]
    for p, doubt in ((0.5, ", which may be chance"), (1e-6, "")):
        unsure = dataclasses.replace(best.gain_in_time, mean=-0.8, adjusted=p)
        said = _in_time(dataclasses.replace(best, gain_in_time=unsure), base)
        assert said[0].endswith(f"is 0.80 dB behind{doubt}.")


def test_scores_between_two_tests_of_a_curve():
    run = result(30.0, upsample_seconds=1.0)  # tests at 2, 4, ... 20 s; 21 dB, 22 dB, ... 30 dB
    assert psnr_at(run, 2.9) is None
    assert psnr_at(run, 3.0) == pytest.approx(21.0)
    assert psnr_at(run, 4.0) == pytest.approx(21.5)
    assert psnr_at(run, 99.0) == 30.0


def test_tables_and_sentences_can_be_read():
    study = _study()
    text = "".join(to_markdown(each(study)) for each in (arm_table, scene_arm_table, seconds_table))
    assert "co-visible" in text
    assert "baseline" in text
    assert "90%" in text  # of the pixels are seen by two training views
    said = " ".join(answer_at_equal_cost(study))
    assert "comes out best" in said
    assert "sfm + default" in said
    assert "seeding counted" in said
    assert "at most 5,000 Gaussians" in study.description
    assert unequal_numbers(study) is None
    assert "with equal numbers of Gaussians" in said


def test_arms_that_do_not_fill_the_budget_are_told():
    study = _study(plain=3000)
    assert "3,000 to 5,000 Gaussians" in unequal_numbers(study)
    assert "--budgets" not in unequal_numbers(study)
    said = " ".join(answer_at_equal_cost(study))
    assert "under one budget of Gaussians" in said
    assert "equal numbers" not in said


@pytest.mark.parametrize(
    ("gain", "says"),
    [
        (-0.5, "nothing beats sfm + default: mls 8x + default comes closest, 0.50 dB"),
        (0.0, "nothing beats sfm + default: mls 8x + default comes closest, level with sfm"),
        (0.5, "mls 8x + default comes out best: 0.50 dB"),
    ],
)
def test_only_a_gain_is_called_best(gain, says):
    gains = {("sfm", 1): 0.0, ("mls", 8): gain}
    (study,) = studies(rows(gains=gains, noise=0.0, strategies=("default",)))
    assert says in answer_at_equal_cost(study)[0]


def test_a_few_repeats_of_one_scene_are_not_called_chance():
    """Beside it stands the test by the noise of all variants, which two repeats may pass."""
    (study,) = studies(rows(scenes=("fox",), strategies=("default",), repeats=2, noise=0.3))
    assert "these two arms' 2 repeats alone do not confirm" in answer_at_equal_cost(study)[0]


def test_lpips_reaches_the_tables_where_it_was_measured():
    study = _study()
    assert "LPIPS" not in arm_table(study).header
    row = rows(repeats=1)[0]
    measured = [
        dataclasses.replace(r, result=result(20.0, lpips=0.2))
        for r in rows(strategies=("default",), repeats=2)
    ]
    (study,) = studies(measured)
    assert "LPIPS" in arm_table(study).header
    assert row.result.lpips is None


def test_a_ledger_without_the_scenes_own_points_has_no_baseline():
    (study,) = studies(rows(gains={("mls", 8): 0.5}))
    assert baseline_of(study) is None
    assert compared_arms(study) == ()
    assert answer_at_equal_cost(study) == ()
