"""Tables say what is in the runs: numbers by hand, planted gains marked, nothing else."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest

pytest.importorskip("pandas", reason="tables need pandas")

from splatseed.bench import comparisons, study_tables
from splatseed.bench.comparisons import baseline_of, compared_arms, gains
from splatseed.bench.plan import SFM
from splatseed.bench.report import conclude, unequal_numbers
from splatseed.bench.runs import BenchRun
from splatseed.bench.study import studies
from splatseed.bench.tables import Number, Table, write_table

from .planted import GAINS, SCENES, result, runs

MLS8 = "mls 8x"
FOX = ("fox",)


def one(finished):
    (study,) = studies(finished)
    return study


def column(table, name):
    place = table.header.index(name)
    return {row[0]: row[place] for row in table.rows}


def test_cells_are_means_and_standard_errors_over_repeats():
    finished = runs(scenes=FOX)
    table = study_tables.psnr_table(one(finished), "none")
    values = [r.result.psnr for r in finished if r.spec.arm.label == MLS8]
    cell = column(table, MLS8)["fox"]
    assert cell.value == pytest.approx(np.mean(values))
    assert cell.se == pytest.approx(np.std(values, ddof=1) / math.sqrt(3))
    assert (cell.bold, cell.mark) == (True, "†")  # the best that was planted
    assert not column(table, "mls 4x")["fox"].bold


def test_noise_is_not_marked_as_best():
    null, bold = dict.fromkeys(GAINS, 0.0), 0
    for seed in range(20):
        study = one(runs(scenes=FOX, gains=null, seed=seed))
        ((_, *cells),) = study_tables.psnr_table(study, "none").rows
        bold += sum(cell.bold for cell in cells)
    assert bold <= 3


def test_planted_gains_come_back():
    table = study_tables.gain_table(one(runs()), "none")
    for (method, ratio), gain in list(GAINS.items())[1:]:
        cells = column(table, f"{method} {ratio}x")
        for mean in ("mean, these scenes", "mean, scenes like these"):
            assert cells[mean].value == pytest.approx(gain, abs=0.04)
            assert cells[mean].mark == ""


def test_runs_without_a_baseline_gain_nothing():
    study = one([r for r in runs() if r.spec.arm.method != SFM or r.spec.scene.name != "fox"])
    assert gains(study, "none").scenes == ("bonsai", "room0", "treehill")
    alone = one(runs(gains={("mls", 8): 0.5}))
    assert (baseline_of(alone), compared_arms(alone), len(conclude(alone))) == (None, (), 1)


def test_runs_of_other_settings_are_never_paired():
    fox = runs(scenes=FOX)
    first, second = studies([*fox, *runs(scenes=FOX, max_steps=2000)[:7]])
    assert (first.settings["max_steps"], second.settings["max_steps"]) == (1000, 2000)
    assert len(studies([*fox, *runs(scenes=FOX, version="0.2.0")])) == 2
    assert len(studies([*fox, *runs(scenes=FOX, data_factor=2)])) == 2
    sizes = one([*fox, *runs(scenes=("bonsai",), data_factor=2)]).settings
    assert sizes["data_factor"] == {"bonsai": 2, "fox": 4}
    both = one([*fox, *runs(scenes=FOX, digest="zz99")])
    assert both.scenes == ("fox (fox0)", "fox (zz99)")
    renamed = one([*fox, *runs(scenes=("a/fox",), digest="fox0123")])
    assert (renamed.scenes, len(renamed.runs)) == (FOX, len(fox))


def test_parameters_and_profiles_are_variants_of_their_own():
    """But what a plan always asks of methods that look at photographs is no part of a name."""
    more = [
        run
        for method, changes in (
            ("mls", {"parameters": {"k": 12}}), ("mls", {"profile": "paper"}),
            ("depth", {"parameters": {"test_every": 8, "cloud.test_every": 8}}),
            ("depth", {"parameters": {"test_every": 4}}),
            ("cloud", {"scan": "aaaa1"}), ("cloud", {"scan": "bbbb2"}),
        )
        for run in runs(scenes=FOX, gains={(method, 8): 0.1}, **changes)
    ]  # fmt: skip
    study = one([*runs(scenes=FOX, repeats=2), *more])
    assert list(study.seeded) == [
        "linear 8x", "mls 4x", "mls 8x", "mls 8x k=12", "mls 8x (paper)", "depth 8x",
        "depth 8x test_every=4", "random 8x", "cloud 8x scan=aaaa", "cloud 8x scan=bbbb",
    ]  # fmt: skip
    assert study.description.endswith("splatseed 0.1.0, 2 to 3 repeats")


def test_costs_are_means_over_scenes():
    table = study_tables.cost_table(one(runs(scenes=("bonsai", "fox"))), "none")
    assert column(table, "Gaussians")["mls 4x"].value == 10_000
    assert column(table, "model, MB")["sfm"].value == pytest.approx(5000 * 59 * 4 / 1e6)


def test_reaching_a_target_is_interpolated():
    run = result(30.0)  # rises by 1 dB every 100 steps and 2 s, from 21 at 100
    assert comparisons.reach(run, 24.5) == pytest.approx((450, 9.0 + 0.5))
    assert comparisons.reach(run, 10.0)[0] == 100
    assert comparisons.reach(run, 30.01) == pytest.approx((math.nan, math.nan), nan_ok=True)
    run = result(30.0, upsample_seconds=1.0)  # tests at 2, 4, ... 20 s; 21 dB, 22 dB, ... 30 dB
    scores = [comparisons.psnr_at(run, seconds) for seconds in (2.9, 3.0, 4.0, 99.0)]
    assert scores == pytest.approx([math.nan, 21.0, 21.5, 30.0], nan_ok=True)


def test_tables_are_written_as_csv_and_html(tmp_path):
    odd = Number(-0.0001, 2, 0.5, signed=True, mark="~", bold=True)
    write_table(Table("odd", "title", ("scene", "a_b & c"), (("<s|c>_#1", odd),)), tmp_path)
    kinds = {path.suffix: path.read_text("utf-8") for path in tmp_path.iterdir()}
    assert kinds.keys() == {".csv", ".html"}
    (row,) = list(csv.DictReader(io.StringIO(kinds[".csv"])))
    assert row == {"scene": "<s|c>_#1", "a_b & c": "-0.0001", "a_b & c se": "0.5",
                   "a_b & c mark": "best ~"}  # fmt: skip
    assert "<strong>0.00 ± 0.50</strong>" in kinds[".html"]
    assert "<th>&lt;s|c&gt;_#1</th>" in kinds[".html"]


def budgeted(noise=0.02, plain=5000):
    """Two strategies under one budget, of which ``sfm`` makes ``plain``; seeds take 4 s."""
    finished = []
    for row in runs(strategies=("default", "grow"), noise=noise, seed=3, budget="5000"):
        seconds, count = (1.0, plain) if row.spec.arm.method == SFM else (4.0, 5000)
        changes = {"upsample_seconds": seconds, "num_gaussians": count, "lpips": 0.25, "flip": 0.5}
        finished.append(BenchRun(row.spec, result(row.result.psnr, **changes)))
    return one(finished)


def test_every_arm_stands_beside_one_baseline():
    study = budgeted()
    compared = compared_arms(study)
    by_label = {each.arm.label: each for each in compared}
    assert (baseline_of(study).label, len(by_label)) == ("sfm + default", 10)
    # Levels differ by strategy in what is planted, so only gains within one are known.
    within = by_label["mls 8x + default"]
    assert within.gain.mean == pytest.approx(0.5, abs=0.05)
    assert within.gain.verdict == "better"
    assert within.gains["covisible"].mean == pytest.approx(within.gain.mean)
    assert (within.means["lpips"], within.gains["lpips"].mean) == (0.25, 0.0)
    assert (within.means["flip"], within.gains["flip"].mean) == (0.5, 0.0)
    assert (within.runs, within.scenes, within.means["gaussians"]) == (12, study.scenes, 5000)
    assert by_label["random 8x + default"].gain.mean == pytest.approx(-0.4, abs=0.05)
    order = [each.gain.mean for each in compared]
    assert order == sorted(order, reverse=True)
    assert unequal_numbers(study) is None
    assert "3,000 to 5,000 Gaussians" in unequal_numbers(budgeted(plain=3000))
    base = {(SFM, 1): 0.0}
    numbers = [(runs(scenes=FOX), 5000), (runs(scenes=("big",), gains=base), 9000)]
    equal = [BenchRun(r.spec, result(9.0, num_gaussians=n)) for each, n in numbers for r in each]
    assert unequal_numbers(one(equal)) is None


def test_time_counts_seeding_and_steps_do_not():
    by_label = {each.arm.label: each for each in compared_arms(budgeted(noise=0.0))}
    base, slower = by_label["sfm + default"], by_label["mls 8x + default"]
    assert [base.gains[name].mean for name in ("in_time", "steps", "seconds")] == [0.0, 0.0, 0.0]
    assert slower.gains["in_time"].mean < slower.gain.mean
    # The target is 9.5 of 10 dB up.
    assert math.exp(slower.gains["steps"].mean) == pytest.approx(0.95)
    assert math.exp(slower.gains["seconds"].mean) == pytest.approx((0.95 * 20 + 4) / 21)
    assert slower.reached == slower.runs
    never = by_label["random 8x + default"]
    assert (never.gains["steps"], never.gains["seconds"], never.reached) == (None, None, 0)


@pytest.mark.parametrize(
    ("gain", "changes", "text"),
    [
        (-0.5, {"noise": 0.0}, "no arm beats sfm + none: mls 8x + none is closest, 0.50 dB"),
        (0.5, {"noise": 0.0}, "mls 8x + none is best: 0.50 dB"),
        (0.5, {"noise": 0.3, "scenes": FOX, "repeats": 2},
         "than sfm + none (2 repeats: too few to tell)"),
        (0.5, {"noise": 0.45, "scenes": FOX, "repeats": 4},
         "than sfm + none (within the noise between repeats)"),
    ],
)  # fmt: skip
def test_only_a_gain_is_called_best_and_a_few_repeats_are_not_called_chance(gain, changes, text):
    assert text in conclude(one(runs(gains={(SFM, 1): 0.0, ("mls", 8): gain}, **changes)))[0]


@pytest.mark.parametrize("scenes", [FOX, SCENES])
def test_a_comparison_has_one_verdict_in_all_tables_and_sentences(scenes):
    """Of one scene, all arms estimate the noise; two repeats of a pair alone would not find it."""
    study = one(runs(scenes=scenes, strategies=("default", "none"), repeats=2, noise=0.05, seed=4))
    gained = gains(study, "default")
    expected = gained.on_these if scenes == FOX else gained.on_like
    own = {each.arm.seeds: each.gain for each in compared_arms(study) if each.arm.seeds != SFM
           and each.arm.strategy == "default"}  # fmt: skip
    for label, gain in expected.items():
        for name in ("mean", "se", "df", "n", "p", "adjusted", "unit"):
            assert getattr(own[label], name) == pytest.approx(getattr(gain, name)), name
    assert own[MLS8].verdict == "better"
    marks = column(study_tables.gain_table(study, "default"), "mls 8x")
    assert marks["mean, these scenes"].mark == ""


@pytest.mark.parametrize(("scenes", "repeats"), [(FOX, 2), (SCENES[:2], 1), (SCENES[:3], 5)])
def test_few_scenes_or_repeats_claim_nothing_in_any_table_or_sentence(scenes, repeats):
    """However large the gain: of two scenes at +0.5 ± 0.001 dB, p is under 0.002."""
    planted = {"gains": {(SFM, 1): 0.0, ("mls", 8): 0.5}, "noise": 0.001, "repeats": repeats}
    study = one(runs(scenes=scenes, **planted))
    base, (row, _) = baseline_of(study), study_tables.arm_table(study).rows
    assert [cell.mark for cell in row[3:-4:2]] == ["?"] * 3  # PSNR, co-visible PSNR, SSIM
    assert row[3].value == pytest.approx(0.5, abs=0.01)
    gain_rows = study_tables.gain_table(study, "none").rows
    assert gain_rows[-1][1].mark == "?"
    assert [row[3].mark for row in study_tables.seconds_table(study, base).rows[:1]] == ["?"]
    by_scene = study_tables.scene_arm_table(study, base).rows
    of_scenes = "" if repeats == 5 else "?"
    assert {cell.mark for cell in by_scene[0][2:]} == {of_scenes}
    (first, *_) = conclude(study)
    assert "has the highest mean" in first
    assert "too few to tell" in first


def test_too_few_repeats_are_no_noise():
    planted = {"scenes": FOX, "gains": {(SFM, 1): 0.0, ("mls", 8): 0.02}, "noise": 0.1}
    for repeats, mark in ((1, "?"), (2, "?"), (9, "~")):
        study = one(runs(repeats=repeats, seed=1, **planted))
        table = study_tables.gain_table(study, "none")
        assert {row[1].mark for row in table.rows} == {mark}
        assert study_tables.psnr_table(study, "none").rows[0][2].mark == mark
        assert [row[3].mark for row in study_tables.arm_table(study).rows if row[0] != SFM] == [
            mark
        ]


def test_a_larger_number_is_stated_and_equal_numbers_are_compared():
    planted = {(SFM, 1): 0.0, ("linear", 8): 0.2, ("mls", 8): 0.5}
    ends = {SFM: 5000, "linear": 5020, "mls": 9000}
    for more in (20, 3000):
        ends["linear"] = 5000 + more
        finished = [
            BenchRun(run.spec, result(run.result.psnr, num_gaussians=ends[run.spec.arm.method]))
            for run in runs(scenes=FOX, gains=planted, noise=0.0, strategies=("default",))
        ]
        first, number, equal, *_ = conclude(one(finished))
        assert "mls 8x + default is best: 0.50 dB" in first
        assert "ends with 9,000 Gaussians, sfm + default with 5,000" in number
        if more == 20:
            assert "linear 8x + default is best: 0.20 dB" in equal
        else:
            assert "splatseed bench --budgets 5000, its other options as here, does" in equal
    assert not any("ends with" in said for said in conclude(budgeted(noise=0.0)))


def test_the_answer_names_the_worst_scene_and_the_seconds():
    planted = {"fox": 0.5, "fern": -0.25, "bonsai": 0.1}
    finished = [
        run
        for scene, gain in planted.items()
        for run in runs(
            scenes=(scene,), gains={(SFM, 1): 0.0, ("mls", 8): gain}, noise=0.0, repeats=4
        )
    ]
    assert (
        "; on fern, its worst scene, 0.25 dB less. A run takes 20 s" in conclude(one(finished))[0]
    )
    easy = runs(scenes=FOX, gains={("depth", 8): 0.9}, noise=0.0)  # on one scene only
    assert conclude(one([*finished, *easy]))[0] == conclude(one(finished))[0]
