"""Tables say what is in the ledger: numbers by hand, planted gains marked, nothing else."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import math
import re

import numpy as np
import pytest

from splatseed.bench.analysis.comparisons import equal_count_table, ratio_table, strategy_table
from splatseed.bench.analysis.convergence import convergence_table, reach
from splatseed.bench.analysis.costs import cost_table, quality_table
from splatseed.bench.analysis.gains import clear_best, gains, mean_gains
from splatseed.bench.analysis.paper import DATASETS, dataset_of, paper_dataset
from splatseed.bench.analysis.psnr_tables import gain_table, mean_gain_table, psnr_tables
from splatseed.bench.analysis.study import BASELINE, Variant, studies
from splatseed.bench.analysis.tables import (
    Cell,
    Table,
    to_csv,
    to_markdown,
    to_tex,
    words,
    write_table,
)
from splatseed.bench.planning.records import SFM, RunRow

from ..planted import GAINS, SCENES, result, rows, spec

MLS8 = Variant("mls", ratio=8.0)


def one(finished):
    (study,) = studies(finished)
    return study


def column(table, name):
    place = table.header.index(name)
    return {row[0].text: row[place] for row in table.rows}


def test_the_papers_tables_are_whole():
    sizes = {"mipnerf360": (9, 16), "replica": (8, 13)}
    for key in DATASETS:
        dataset = paper_dataset(key)
        assert (len(dataset.psnr), *{len(each) for each in dataset.psnr.values()}) == sizes[key]
        assert set(dataset.costs) >= {("sfm", 1.0), ("mls", 8.0)}
    assert paper_dataset("replica").gain("room0", ("mls", 16.0)) == pytest.approx(0.283)
    assert dataset_of("bonsai").key == "mipnerf360"
    assert dataset_of("my kitchen") is None


def test_the_papers_three_mean_gains():
    """As recomputed from its tables by hand, see docs/paper.md."""
    theirs = column(mean_gain_table(one(rows())), "all variants together")
    assert theirs["paper, Mip-NeRF360"].value == pytest.approx(0.117, abs=5e-4)
    assert theirs["paper, Replica"].value == pytest.approx(0.343, abs=5e-4)
    best = column(mean_gain_table(one(rows())), "best single variant")
    assert best["paper, Mip-NeRF360"].value == pytest.approx(0.202, abs=5e-4)
    assert best["paper, Replica"].value == pytest.approx(0.507, abs=5e-4)
    unfair = column(mean_gain_table(one(rows())), "best of each scene (unfair)")
    assert unfair["paper, Mip-NeRF360"].value == pytest.approx(0.258, abs=5e-4)
    assert unfair["paper, Replica"].value == pytest.approx(0.646, abs=5e-4)


def test_cells_are_means_and_standard_errors_over_repeats():
    finished = rows(scenes=("fox",))
    (table,) = psnr_tables(one(finished), "none")
    values = [r.result.psnr for r in finished if r.spec.arm.label == "mls 8x"]
    cell = column(table, "mls 8x")["fox"]
    assert cell.value == pytest.approx(np.mean(values))
    assert cell.se == pytest.approx(np.std(values, ddof=1) / math.sqrt(3))


def test_scenes_of_the_paper_have_its_numbers_below():
    tables = psnr_tables(one(rows()), "none")
    assert [table.name for table in tables] == ["table1_none", "table2_none", "table_scenes_none"]
    assert column(tables[0], "mls 8x")["bonsai (paper)"].value == 32.572
    assert column(tables[1], "mls 8x")["room0 (paper)"].value is None
    assert [row[0].text for row in tables[2].rows] == ["fox"]


def test_a_planted_best_is_marked_and_noise_is_not():
    (table,) = psnr_tables(one(rows(scenes=("fox",))), "none")
    cells = column(table, "mls 8x")["fox"], column(table, "mls 4x")["fox"]
    assert [(cell.bold, cell.mark) for cell in cells] == [(True, "†"), (False, "")]
    null = dict.fromkeys(GAINS, 0.0)
    bold = [
        cell.bold
        for seed in range(20)
        for table in psnr_tables(one(rows(scenes=("fox",), gains=null, seed=seed)), "none")
        for row in table.rows
        for cell in row
    ]
    assert sum(bold) <= 3


def test_two_equal_bests_are_not_told_apart():
    same = {(SFM, 1): 0.0, ("mls", 4): 0.5, ("mls", 8): 0.5}
    (table,) = psnr_tables(one(rows(scenes=("fox",), gains=same)), "none")
    marks = [(c.bold, c.mark) for c in table.rows[0][2:]]
    assert sorted(marks) == [(False, ""), (True, "")]
    assert not clear_best(one(rows(scenes=("fox",), gains=same)), "none", "fox")


def test_the_cloud_as_it_is_can_be_best():
    worse = {(SFM, 1): 0.0, ("mls", 4): -0.5, ("random", 8): -0.9}
    (table,) = psnr_tables(one(rows(scenes=("fox",), gains=worse)), "none")
    assert column(table, "sfm")["fox"].bold


def test_planted_gains_come_back():
    table = gain_table(one(rows()), "none")
    for (method, ratio), gain in list(GAINS.items())[1:]:
        cells = column(table, f"{method} {ratio}x")
        for mean in ("mean, these scenes", "mean, scenes like these"):
            assert cells[mean].value == pytest.approx(gain, abs=0.04)
            assert cells[mean].mark == ""
    theirs = [paper_dataset("mipnerf360").gain(s, ("mls", 8.0)) for s in ("bonsai", "treehill")]
    shown = column(table, "mls 8x")["paper, 2 of 9 Mip-NeRF360 scenes"]
    assert shown.value == pytest.approx(np.mean(theirs))


def test_one_repeat_says_so():
    study = one(rows(repeats=1))
    shown = to_markdown(psnr_tables(study, "none")[0])
    assert shown.count("(1 run)") == 2 * 5 + 1  # and in the notes
    assert "**2" not in shown
    verdicts = {each.verdict for each in gains(study, "none").on_scene.values()}
    assert verdicts == {"unknown"}
    assert gains(study, "none").on_like[MLS8].verdict == "better"  # the scenes agree


def test_a_single_run_makes_tables_all_the_same():
    study = one(rows(scenes=("fox",), gains={(SFM, 1): 0.0}, repeats=1))
    (table,) = psnr_tables(study, "none")
    assert table.header == ("scene", "sfm")
    for make in (gain_table, cost_table, convergence_table):
        assert to_csv(make(study, "none"))
    for make in (ratio_table, strategy_table, equal_count_table, mean_gain_table):
        assert to_markdown(make(study))


def test_runs_without_a_baseline_gain_nothing():
    study = one([r for r in rows() if r.spec.arm.method != SFM or r.spec.scene != "fox"])
    assert gains(study, "none").scenes == ("bonsai", "room0", "treehill")
    (own,) = [table for table in psnr_tables(study, "none") if "scenes" in table.name]
    assert column(own, "sfm")["fox"] == Cell()
    assert column(own, "mls 8x")["fox"].value is not None


def test_infinite_scores_are_set_aside():
    perfect = RunRow(spec("fox", "mls", 8, repeat=3), "done", result(math.inf))
    study = one([*rows(), perfect])
    assert study.not_finite == ("fox, mls 8x, none, 3",)
    assert 3 not in study.cell("none", "fox", MLS8)


def test_runs_of_other_settings_are_never_paired():
    more = rows(max_steps=2000)[:7]
    first, second = studies([*rows(), *more])
    assert (first.settings["max_steps"], second.settings["max_steps"]) == (1000, 2000)
    assert len(studies([*rows(), *rows(version="0.2.0")])) == 2
    assert len(studies([*rows(), *rows(data_factor=2)])) == 2
    sizes = one([*rows(scenes=("fox",)), *rows(scenes=("bonsai",), data_factor=2)]).settings
    assert sizes["data_factor"] == {"bonsai": 2, "fox": 4}


def test_a_scene_that_changed_is_another_scene():
    changed = [
        dataclasses.replace(r, spec=dataclasses.replace(r.spec, scene_digest="zz99"))
        for r in rows(scenes=("fox",))
    ]
    assert one([*rows(scenes=("fox",)), *changed]).scenes == ("fox (fox0)", "fox (zz99)")


def test_parameters_and_profiles_are_variants_of_their_own():
    k = rows(scenes=("fox",), gains={("mls", 8): 0.1}, parameters={"k": 12})
    paper = rows(scenes=("fox",), gains={("mls", 8): 0.1}, profile="paper")
    study = one([*rows(scenes=("fox",)), *k, *paper])
    labels = [variant.label for variant in study.variants]
    assert labels == ["linear 8x", "mls 4x", "mls 8x", "mls 8x k=12", "mls 8x (paper)", "random 8x"]


def test_what_a_plan_always_asks_of_depth_is_no_part_of_its_name():
    held = rows(
        scenes=("fox",), gains={("depth", 4): 0.1}, parameters={"hold_out": 8, "cloud.hold_out": 8}
    )
    other = rows(scenes=("fox",), gains={("depth", 4): 0.1}, parameters={"hold_out": 4})
    study = one([*rows(scenes=("fox",), repeats=2), *held, *other])
    labels = [variant.label for variant in study.variants if variant.method == "depth"]
    assert labels == ["depth 4x", "depth 4x hold_out=4"]
    assert study.description.endswith("splatseed 0.1.0, 2 to 3 repeats")


def test_costs_are_means_over_scenes_and_the_papers_stand_beside():
    table = cost_table(one(rows(scenes=("bonsai", "fox"))), "none")
    assert column(table, "Gaussians")["mls 4x"].value == 10_000
    assert column(table, "model, MB")["sfm"].value == pytest.approx(5000 * 59 * 4 / 1e6)
    assert "peak GPU memory, MB" not in table.header
    assert column(table, "paper, training, s (Mip-NeRF360)")["mls 8x"].value == 1503
    unknown = [
        dataclasses.replace(r, result=dataclasses.replace(r.result, peak_bytes=None))
        for r in rows(scenes=("fox",))
    ]
    assert "peak memory, MB" not in cost_table(one(unknown), "none").header


def test_quality_is_told_as_far_as_it_was_measured():
    table = quality_table(one(rows(scenes=("fox", "room0"))), "none")
    assert table.header == ("method", "PSNR, dB", "co-visible PSNR, dB", "SSIM", "scenes")
    assert column(table, "SSIM")["mls 8x"].value == pytest.approx(0.8)
    some = [dataclasses.replace(r, result=result(20.0, lpips=0.25)) for r in rows()]
    assert column(quality_table(one(some), "none"), "LPIPS")["sfm"].value == pytest.approx(0.25)


def test_reaching_a_target_is_interpolated():
    run = result(30.0)  # rises by 1 dB every 100 steps and 2 s, from 21 at 100
    assert reach(run, 24.5).steps == pytest.approx(450)
    assert reach(run, 24.5).seconds == pytest.approx(9.0 + 0.5)
    assert reach(run, 10.0).steps == 100
    assert reach(run, 30.01) is None


def test_convergence_counts_those_that_never_arrive():
    table = convergence_table(one(rows()), "none")
    assert column(table, "reached")["random 8x"].text == "0 of 12"
    assert column(table, "steps ratio")["random 8x"] == Cell()
    # 0.5 dB more, rising in 900 steps instead of 1000: the target is 9.5 of 10 dB up.
    ratio = column(table, "steps ratio")["mls 8x"]
    assert ratio.value == pytest.approx(0.95 * 0.9, abs=0.01)
    assert ratio.mark == ""


def test_equal_counts_are_looked_up():
    study = one(rows(strategies=("mcmc", "none")))
    assert {row[0].text for row in equal_count_table(study).rows} == {"mcmc"}
    none = equal_count_table(one(rows(strategies=("none",))))
    assert not none.rows
    assert "None qualifies" in none.notes[0]


def test_gains_by_ratio_and_by_strategy():
    study = one(rows(strategies=("default", "none")))
    ratios = ratio_table(study)
    assert ratios.header == ("strategy", "method", "4x", "8x")
    row = next(row for row in ratios.rows if [c.text for c in row[:2]] == ["none", "mls"])
    assert [cell.value for cell in row[2:]] == pytest.approx([0.2, 0.5], abs=0.05)
    assert column(strategy_table(study), "default")["linear 8x"].value == pytest.approx(
        0.3, abs=0.05
    )


def test_the_fair_mean_is_of_variants_that_all_scenes_have():
    means = mean_gains({"a": {MLS8: 1.0, Variant("depth"): 9.0}, "b": {MLS8: 0.5}})
    assert (means.over_all, means.best, means.per_scene) == (0.75, "mls 8x", 0.75)
    assert mean_gains({"a": {MLS8: 1.0}, "b": {}}) is None
    assert mean_gains({}) is None


ODD = Table(
    "odd",
    "50% of $1 | a_b {x} \\",
    ("scene", "a_b & c"),
    ((words("<s|c>_#1"), Cell(-0.0001, 0.5, 2, signed=True, mark="~", bold=True)),),
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


def test_all_kinds_are_written(tmp_path):
    names = [path.name for path in write_table(ODD, tmp_path)]
    assert names == ["odd.csv", "odd.md", "odd.tex"]
    assert BASELINE.label == SFM
    assert set(SCENES) > {"fox"}
