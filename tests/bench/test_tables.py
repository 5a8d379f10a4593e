"""Tables say what is in the runs: numbers by hand, planted gains marked, nothing else."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
import re

import numpy as np
import pytest
from scipy import stats

pytest.importorskip("pandas", reason="tables need pandas")

from splatseed.bench.comparisons import (
    DATASETS,
    baseline_of,
    compare,
    compared_arms,
    dataset_of,
    gains,
    paper_dataset,
    psnr_at,
    reach,
    score_advice,
)
from splatseed.bench.plan import SFM
from splatseed.bench.report import answer_at_equal_cost, unequal_numbers
from splatseed.bench.runs import Run
from splatseed.bench.study import Variant, studies
from splatseed.bench.study_tables import (
    advice_table,
    arm_table,
    comparison_tables,
    convergence_table,
    cost_table,
    equal_count_table,
    gain_table,
    mean_gain_table,
    psnr_tables,
    quality_table,
    scene_arm_table,
    seconds_table,
)
from splatseed.bench.tables import (
    Number,
    Table,
    to_csv,
    to_html,
    to_markdown,
    to_tex,
    write_table,
)

from .planted import GAINS, result, runs, spec

MLS8 = "mls 8x"


def one(finished):
    (study,) = studies(finished)
    return study


def column(table, name):
    place = table.header.index(name)
    return {row[0]: row[place] for row in table.rows}


def test_the_papers_tables_are_whole():
    sizes = {"mipnerf360": (9, 16), "replica": (8, 13)}
    for key in DATASETS:
        dataset = paper_dataset(key)
        assert (len(dataset.psnr), *{len(each) for each in dataset.psnr.values()}) == sizes[key]
        assert set(dataset.costs) >= {("sfm", 1.0), ("mls", 8.0)}
    assert paper_dataset("replica").gain("room0", Variant("mls", ratio=16.0)) == pytest.approx(
        0.283
    )
    assert dataset_of("bonsai").key == "mipnerf360"
    assert dataset_of("my kitchen") is None


def test_the_papers_three_mean_gains():
    """As recomputed from its tables by hand, see docs/paper.md."""
    theirs = column(mean_gain_table(one(runs())), "all variants together")
    assert theirs["paper, Mip-NeRF360"].value == pytest.approx(0.117, abs=5e-4)
    assert theirs["paper, Replica"].value == pytest.approx(0.343, abs=5e-4)
    best = column(mean_gain_table(one(runs())), "best single variant")
    assert best["paper, Mip-NeRF360"].value == pytest.approx(0.202, abs=5e-4)
    assert best["paper, Replica"].value == pytest.approx(0.507, abs=5e-4)
    unfair = column(mean_gain_table(one(runs())), "best of each scene (unfair)")
    assert unfair["paper, Mip-NeRF360"].value == pytest.approx(0.258, abs=5e-4)
    assert unfair["paper, Replica"].value == pytest.approx(0.646, abs=5e-4)


def test_cells_are_means_and_standard_errors_over_repeats():
    finished = runs(scenes=("fox",))
    (table,) = psnr_tables(one(finished), "none")
    values = [r.result.psnr for r in finished if r.spec.arm.label == "mls 8x"]
    cell = column(table, "mls 8x")["fox"]
    assert cell.value == pytest.approx(np.mean(values))
    assert cell.se == pytest.approx(np.std(values, ddof=1) / math.sqrt(3))


def test_scenes_of_the_paper_have_its_numbers_below():
    tables = psnr_tables(one(runs()), "none")
    assert [table.name for table in tables] == ["table1_none", "table2_none", "table_scenes_none"]
    assert column(tables[0], "mls 8x")["bonsai (paper)"].value == 32.572
    assert math.isnan(column(tables[1], "mls 8x")["room0 (paper)"].value)
    assert [row[0] for row in tables[2].rows] == ["fox"]


def test_a_planted_best_is_marked_and_noise_is_not():
    (table,) = psnr_tables(one(runs(scenes=("fox",))), "none")
    cells = column(table, "mls 8x")["fox"], column(table, "mls 4x")["fox"]
    assert [(cell.bold, cell.mark) for cell in cells] == [(True, "†"), (False, "")]
    null = dict.fromkeys(GAINS, 0.0)
    bold = [
        cell.bold
        for seed in range(20)
        for table in psnr_tables(one(runs(scenes=("fox",), gains=null, seed=seed)), "none")
        for row in table.rows
        for cell in row[1:]
    ]
    assert sum(bold) <= 3


def test_the_cloud_as_it_is_can_be_best():
    worse = {(SFM, 1): 0.0, ("mls", 4): -0.5, ("random", 8): -0.9}
    (table,) = psnr_tables(one(runs(scenes=("fox",), gains=worse)), "none")
    assert column(table, "sfm")["fox"].bold


def test_planted_gains_come_back():
    table = gain_table(one(runs()), "none")
    for (method, ratio), gain in list(GAINS.items())[1:]:
        cells = column(table, f"{method} {ratio}x")
        for mean in ("mean, these scenes", "mean, scenes like these"):
            assert cells[mean].value == pytest.approx(gain, abs=0.04)
            assert cells[mean].mark == ""
    theirs = [
        paper_dataset("mipnerf360").gain(s, Variant("mls", ratio=8.0))
        for s in ("bonsai", "treehill")
    ]
    shown = column(table, "mls 8x")["paper, 2 of 9 Mip-NeRF360 scenes"]
    assert shown.value == pytest.approx(np.mean(theirs))


def test_one_repeat_says_so():
    study = one(runs(repeats=1))
    shown = to_markdown(psnr_tables(study, "none")[0])
    assert shown.count("(1 run)") == 2 * 5 + 1  # and in the notes
    assert "**2" not in shown
    verdicts = {each.verdict for each in gains(study, "none").on_scene.values()}
    assert verdicts == {"unknown"}
    assert gains(study, "none").on_like[MLS8].verdict == "better"  # the scenes agree


def test_runs_without_a_baseline_gain_nothing():
    study = one([r for r in runs() if r.spec.arm.method != SFM or r.spec.scene != "fox"])
    assert gains(study, "none").scenes == ("bonsai", "room0", "treehill")
    (own,) = [table for table in psnr_tables(study, "none") if "scenes" in table.name]
    assert not column(own, "sfm")["fox"]
    assert column(own, "mls 8x")["fox"].value is not None


def test_runs_of_other_settings_are_never_paired():
    more = runs(max_steps=2000)[:7]
    first, second = studies([*runs(), *more])
    assert (first.settings["max_steps"], second.settings["max_steps"]) == (1000, 2000)
    assert len(studies([*runs(), *runs(version="0.2.0")])) == 2
    assert len(studies([*runs(), *runs(data_factor=2)])) == 2
    sizes = one([*runs(scenes=("fox",)), *runs(scenes=("bonsai",), data_factor=2)]).settings
    assert sizes["data_factor"] == {"bonsai": 2, "fox": 4}


def test_a_scene_that_changed_is_another_scene():
    changed = [
        dataclasses.replace(r, spec=dataclasses.replace(r.spec, scene_digest="zz99"))
        for r in runs(scenes=("fox",))
    ]
    assert one([*runs(scenes=("fox",)), *changed]).scenes == ("fox (fox0)", "fox (zz99)")


def test_parameters_and_profiles_are_variants_of_their_own():
    k = runs(scenes=("fox",), gains={("mls", 8): 0.1}, parameters={"k": 12})
    paper = runs(scenes=("fox",), gains={("mls", 8): 0.1}, profile="paper")
    study = one([*runs(scenes=("fox",)), *k, *paper])
    assert list(study.seeded) == [
        "linear 8x",
        "mls 4x",
        "mls 8x",
        "mls 8x k=12",
        "mls 8x (paper)",
        "random 8x",
    ]


def test_what_a_plan_always_asks_of_depth_is_no_part_of_its_name():
    held = runs(
        scenes=("fox",), gains={("depth", 4): 0.1}, parameters={"hold_out": 8, "cloud.hold_out": 8}
    )
    other = runs(scenes=("fox",), gains={("depth", 4): 0.1}, parameters={"hold_out": 4})
    study = one([*runs(scenes=("fox",), repeats=2), *held, *other])
    assert [label for label in study.seeded if "depth" in label] == [
        "depth 4x",
        "depth 4x hold_out=4",
    ]
    assert study.description.endswith("splatseed 0.1.0, 2 to 3 repeats")


def test_costs_are_means_over_scenes_and_the_papers_stand_beside():
    table = cost_table(one(runs(scenes=("bonsai", "fox"))), "none")
    assert column(table, "Gaussians")["mls 4x"].value == 10_000
    assert column(table, "model, MB")["sfm"].value == pytest.approx(5000 * 59 * 4 / 1e6)
    assert "peak GPU memory, MB" not in table.header
    assert column(table, "paper, training, s (Mip-NeRF360)")["mls 8x"].value == 1503
    unknown = [
        dataclasses.replace(r, result=dataclasses.replace(r.result, peak_bytes=None))
        for r in runs(scenes=("fox",))
    ]
    assert "peak memory, MB" not in cost_table(one(unknown), "none").header


def test_quality_is_told_as_far_as_it_was_measured():
    table = quality_table(one(runs(scenes=("fox", "room0"))), "none")
    assert table.header == ("method", "PSNR, dB", "co-visible PSNR, dB", "SSIM", "scenes")
    assert column(table, "SSIM")["mls 8x"].value == pytest.approx(0.8)
    some = [dataclasses.replace(r, result=result(20.0, lpips=0.25)) for r in runs()]
    assert column(quality_table(one(some), "none"), "LPIPS")["sfm"].value == pytest.approx(0.25)


def test_reaching_a_target_is_interpolated():
    run = result(30.0)  # rises by 1 dB every 100 steps and 2 s, from 21 at 100
    assert reach(run, 24.5).steps == pytest.approx(450)
    assert reach(run, 24.5).seconds == pytest.approx(9.0 + 0.5)
    assert reach(run, 10.0).steps == 100
    assert reach(run, 30.01) is None


def test_convergence_counts_those_that_never_arrive():
    table = convergence_table(one(runs()), "none")
    assert column(table, "reached")["random 8x"] == "0 of 12"
    assert column(table, "steps ratio")["random 8x"] == ""
    # 0.5 dB more, rising in 900 steps instead of 1000: the target is 9.5 of 10 dB up.
    ratio = column(table, "steps ratio")["mls 8x"]
    assert ratio.value == pytest.approx(0.95 * 0.9, abs=0.01)
    assert ratio.mark == ""


def test_equal_counts_are_looked_up():
    study = one(runs(strategies=("mcmc", "none")))
    assert {row[0] for row in equal_count_table(study).rows} == {"mcmc"}
    none = equal_count_table(one(runs(strategies=("none",))))
    assert not none.rows
    assert "None qualifies" in none.notes[0]


ODD = Table(
    "odd",
    "50% of $1 | a_b {x} \\",
    ("scene", "a_b & c"),
    (("<s|c>_#1", Number(-0.0001, 2, 0.5, signed=True, mark="~", bold=True)),),
    ("~ means ±", "math.inf is ∞"),
)


def test_csv_is_read_back_in_full():
    (row,) = list(csv.DictReader(io.StringIO(to_csv(ODD))))
    assert row == {"scene": "<s|c>_#1", "a_b & c": "-0.0001", "a_b & c se": "0.5",
                   "a_b & c mark": "best ~"}  # fmt: skip


def test_markdown_keeps_its_columns():
    lines = to_markdown(ODD).splitlines()
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines[2:5]}) == 1
    assert "**0.00 ± 0.50** ~" in lines[4]


def test_tex_escapes_what_it_must():
    text = to_tex(ODD)
    assert r"50\% of \$1 | a\_b \{x\} \textbackslash{}" in text
    assert r"\textbf{0.00 $\pm$ 0.50} $\sim$" in text
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    for begin, end in itertools.pairwise([r"\begin{table}", r"\begin{tabular}", r"\end{tabular}"]):
        assert text.index(begin) < text.index(end)


def test_html_escapes_and_heads_its_rows():
    text = to_html(ODD)
    assert "<th>&lt;s|c&gt;_#1</th>" in text
    assert '<td><strong>0.00 ± 0.50</strong> <span class="mark">~</span></td>' in text


def test_all_kinds_are_written(tmp_path):
    names = [path.name for path in write_table(ODD, tmp_path)]
    assert names == ["odd.csv", "odd.md", "odd.tex", "odd.html"]


def _study(noise=0.02, plain=5000, **changes):
    """Two strategies under one budget, of which ``sfm`` makes ``plain``: ``grow`` has 0.3 dB more,
    its seeds take 4 s."""
    finished = []
    for row in runs(strategies=("default", "grow"), noise=noise, seed=3, **changes):
        arm = dataclasses.replace(row.spec.arm, budget="5000", ratio=row.spec.arm.ratio)
        run = dataclasses.replace(row.spec, arm=arm)
        more = 0.3 if arm.strategy == "grow" else 0.0
        seconds, count = (0.0, plain) if arm.method == "sfm" else (4.0, 5000)
        made = result(row.result.psnr + more, upsample_seconds=seconds, num_gaussians=count)
        finished.append(Run(run, made))
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
    assert within.gains["covisible"].mean == pytest.approx(within.gain.mean)
    assert (within.runs, within.scenes) == (12, study.scenes)
    assert within.means["gaussians"] == 5000
    assert by_label["random 8x + default"].gain.mean == pytest.approx(-0.4, abs=0.05)
    assert [each.gain.mean for each in compared_arms(study)] == sorted(
        (each.gain.mean for each in compared_arms(study)), reverse=True
    )


def test_time_counts_seeding():
    study = _study(noise=0.0)
    by_label = {each.arm.label: each for each in compared_arms(study)}
    base = by_label["sfm + default"]
    assert base.gains["sooner"].mean == pytest.approx(0.0)
    assert base.gains["in_time"].mean == pytest.approx(0.0)
    slower = by_label["mls 8x + default"]
    assert slower.means["seeding"] == 4.0
    assert slower.gains["in_time"].mean < slower.gain.mean
    assert slower.reached == slower.runs


def test_scores_between_two_tests_of_a_curve():
    run = result(30.0, upsample_seconds=1.0)  # tests at 2, 4, ... 20 s; 21 dB, 22 dB, ... 30 dB
    assert math.isnan(psnr_at(run, 2.9))
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
    (study,) = studies(runs(gains=gains, noise=0.0, strategies=("default",)))
    assert says in answer_at_equal_cost(study)[0]


def test_a_few_repeats_of_one_scene_are_not_called_chance():
    """Beside it stands the test by the noise of all variants, which two repeats may pass."""
    (study,) = studies(runs(scenes=("fox",), strategies=("default",), repeats=2, noise=0.3))
    assert "these two arms' 2 repeats alone do not confirm" in answer_at_equal_cost(study)[0]


def test_lpips_reaches_the_tables_where_it_was_measured():
    study = _study()
    assert "LPIPS" not in arm_table(study).header
    measured = [
        dataclasses.replace(r, result=result(20.0, lpips=0.2))
        for r in runs(strategies=("default",), repeats=2)
    ]
    (study,) = studies(measured)
    assert "LPIPS" in arm_table(study).header


def test_a_ledger_without_the_scenes_own_points_has_no_baseline():
    (study,) = studies(runs(gains={("mls", 8): 0.5}))
    assert baseline_of(study) is None
    assert compared_arms(study) == ()
    assert answer_at_equal_cost(study) == ()


def _advised(room):
    """Scenes by what auto gains on them, and how many seeds a run of sfm begins with of 10,000."""
    finished = []
    for scene, (gain, seeds) in room.items():
        for method, more in (("sfm", 0.0), ("mls", -0.2), ("auto", gain)):
            ratio = 1 if method == "sfm" else 0
            run = spec(scene, method, ratio, budget="10000", cap_max=10_000)
            count = seeds if method == "sfm" else 10_000
            finished.append(Run(run, result(25.0 + more, num_seeds=count)))
    return one(finished)


SPARSE_GAIN = {"fern": (0.5, 2_000), "fox": (0.3, 4_000), "bonsai": (-0.3, 10_000),
               "treehill": (-0.1, 10_000)}  # fmt: skip


def test_advice_that_holds_is_right_everywhere():
    study = _advised(SPARSE_GAIN)
    assert score_advice(study, "none").advised == {
        "fern": "auto", "fox": "auto", "bonsai": "sfm", "treehill": "sfm",
    }  # fmt: skip
    table = advice_table(study, "none")
    mean = dict(zip(table.header, table.rows[-1], strict=True))
    assert mean["gain over always sfm"].value == pytest.approx(0.2)
    assert mean["gain over always auto"].value == pytest.approx(0.1)
    assert mean["gain over always mls"].value == pytest.approx(0.4)
    assert "4 of 4 scenes" in table.notes[0]


def test_a_scene_does_not_advise_itself():
    """The one whose points should be left, though there is room, is advised as the others are."""
    score = score_advice(_advised({**SPARSE_GAIN, "odd": (-1.0, 2_000)}), "none")
    assert score.advised["odd"] == "auto"
    assert score.gain_over("odd", "sfm") == pytest.approx(-1.0)


BETTER = {**GAINS, ("mls", 8): 0.8}
"""In which mls 8x gains 0.3 dB more than in ``GAINS``."""


def mean_change(comparison, label):
    return next(each for arm, each in comparison.means.items() if arm.seeds == label)


def test_a_planted_change_is_found_and_nothing_else():
    comparison = compare(runs(), runs(gains=BETTER, seed=1, version="0.2.0"))
    assert comparison.settings == (("version", "0.1.0", "0.2.0"),)
    change = comparison.changes["none", MLS8, "fox"]
    assert change.mean == pytest.approx(0.3, abs=0.12)
    verdicts = {arm.seeds: each.verdict for arm, each in comparison.means.items()}
    assert verdicts.pop(MLS8) == "better"
    assert set(verdicts.values()) == {"within noise"}
    _, changes, _ = comparison_tables(comparison)
    assert [row[1] for row in changes.rows if row[-1].mark == "*"] == [MLS8]


def test_one_arm_is_welchs_test():
    a = runs(scenes=("fox",), gains={(SFM, 1): 0.0}, repeats=4)
    b = runs(scenes=("fox",), gains={(SFM, 1): 0.1}, repeats=6, seed=1, noise=0.2)
    scores = [[run.result.psnr for run in each] for each in (a, b)]
    expected = stats.ttest_ind(scores[1], scores[0], equal_var=False)
    difference = compare(a, b).changes["none", "sfm", "fox"]
    assert difference.p == pytest.approx(expected.pvalue)
    assert difference.df == pytest.approx(expected.df)
    assert difference.mean == pytest.approx(np.mean(scores[1]) - np.mean(scores[0]))


def test_no_change_is_claimed_at_most_at_the_stated_rate():
    """Repeats have effects of their own here, which all arms of a scene share."""
    claimed = 0
    for seed in range(40):
        comparison = compare(
            runs(seed=seed, scenes=("fox",)), runs(seed=1000 + seed, scenes=("fox",))
        )
        claimed += any(each.verdict != "within noise" for each in comparison.means.values())
    assert claimed <= 7


def test_single_runs_claim_nothing():
    comparison = compare(runs(repeats=1), runs(repeats=1, seed=1))
    assert {each.verdict for each in comparison.changes.values()} == {"unknown"}
    assert comparison_tables(comparison)[1].rows[0][2].text == "(1 run)"


def test_changed_files_and_nothing_finished():
    fox = runs(scenes=("fox",))
    other = [dataclasses.replace(r, spec=dataclasses.replace(r.spec, scene_digest="z"))
             for r in fox]  # fmt: skip
    assert compare(fox, other).content == ("fox",)
    assert compare(fox, []) is None
