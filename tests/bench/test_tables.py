"""Tables say what is in the runs: numbers by hand, planted gains marked, nothing else."""

from __future__ import annotations

import csv
import io
import math
import re

import numpy as np
import pytest
from scipy import stats

pytest.importorskip("pandas", reason="tables need pandas")

from splatseed.bench import comparisons, study_tables
from splatseed.bench.comparisons import baseline_of, compare, compared_arms, gains
from splatseed.bench.plan import SFM
from splatseed.bench.report import answer, unequal_numbers
from splatseed.bench.runs import Run
from splatseed.bench.study import studies
from splatseed.bench.tables import Number, Table, to_markdown, write_table

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
    for key in comparisons.DATASETS:
        assert comparisons.paper_psnr(key).shape == sizes[key]
        assert comparisons.paper_psnr(key).notna().all(axis=None)
        assert set(comparisons.paper_costs(key).index) >= {("sfm", 1.0), ("mls", 8.0)}
    assert comparisons.paper_gains("replica").loc["room0", ("mls", 16.0)] == pytest.approx(0.283)


def test_the_papers_three_mean_gains():
    """As recomputed from its tables by hand, see docs/paper.md."""
    table = study_tables.mean_gain_table(one(runs()))
    for name, *expected in (
        ("paper, Mip-NeRF360", 0.117, 0.202, 0.258), ("paper, Replica", 0.343, 0.507, 0.646)
    ):  # fmt: skip
        columns = (table.header[1], table.header[2], table.header[4])
        theirs = [column(table, each)[name].value for each in columns]
        assert theirs == pytest.approx(expected, abs=5e-4)


def test_cells_are_means_and_standard_errors_over_repeats():
    finished = runs(scenes=("fox",))
    (table,) = study_tables.psnr_tables(one(finished), "none")
    values = [r.result.psnr for r in finished if r.spec.arm.label == MLS8]
    cell = column(table, MLS8)["fox"]
    assert cell.value == pytest.approx(np.mean(values))
    assert cell.se == pytest.approx(np.std(values, ddof=1) / math.sqrt(3))
    assert (cell.bold, cell.mark) == (True, "†")  # the best that was planted
    assert not column(table, "mls 4x")["fox"].bold
    worse = {(SFM, 1): 0.0, ("mls", 4): -0.5, ("random", 8): -0.9}
    (table,) = study_tables.psnr_tables(one(runs(scenes=("fox",), gains=worse)), "none")
    assert column(table, "sfm")["fox"].bold


def test_scenes_of_the_paper_have_its_numbers_below():
    tables = study_tables.psnr_tables(one(runs()), "none")
    assert [table.name for table in tables] == ["table1_none", "table2_none", "table_scenes_none"]
    assert column(tables[0], MLS8)["bonsai (paper)"].value == 32.572
    assert math.isnan(column(tables[1], MLS8)["room0 (paper)"].value)
    assert [row[0] for row in tables[2].rows] == ["fox"]


def test_noise_is_not_marked_as_best():
    null = dict.fromkeys(GAINS, 0.0)
    bold = [
        cell.bold
        for seed in range(20)
        for table in study_tables.psnr_tables(
            one(runs(scenes=("fox",), gains=null, seed=seed)), "none"
        )
        for row in table.rows
        for cell in row[1:]
    ]
    assert sum(bold) <= 3


def test_planted_gains_come_back():
    table = study_tables.gain_table(one(runs()), "none")
    for (method, ratio), gain in list(GAINS.items())[1:]:
        cells = column(table, f"{method} {ratio}x")
        for mean in ("mean, these scenes", "mean, scenes like these"):
            assert cells[mean].value == pytest.approx(gain, abs=0.04)
            assert cells[mean].mark == ""
    theirs = comparisons.paper_gains("mipnerf360").loc[["bonsai", "treehill"], ("mls", 8.0)]
    shown = column(table, MLS8)["paper, 2 of 9 Mip-NeRF360 scenes"]
    assert shown.value == pytest.approx(np.mean(theirs))


def test_one_repeat_says_so():
    study = one(runs(repeats=1))
    shown = to_markdown(study_tables.psnr_tables(study, "none")[0])
    assert shown.count("(1 run)") == 2 * 5 + 1  # and in the notes
    assert "**2" not in shown
    verdicts = {each.verdict for each in gains(study, "none").on_scene.values()}
    assert verdicts == {"unknown"}
    assert gains(study, "none").on_like[MLS8].verdict == "better"  # the scenes agree


def test_runs_without_a_baseline_gain_nothing():
    study = one([r for r in runs() if r.spec.arm.method != SFM or r.spec.scene.name != "fox"])
    assert gains(study, "none").scenes == ("bonsai", "room0", "treehill")
    (own,) = [table for table in study_tables.psnr_tables(study, "none") if "scenes" in table.name]
    assert (column(own, "sfm")["fox"], bool(column(own, MLS8)["fox"])) == ("", True)
    alone = one(runs(gains={("mls", 8): 0.5}))
    assert (baseline_of(alone), compared_arms(alone), len(answer(alone))) == (None, (), 1)


def test_runs_of_other_settings_are_never_paired():
    first, second = studies([*runs(), *runs(max_steps=2000)[:7]])
    assert (first.settings["max_steps"], second.settings["max_steps"]) == (1000, 2000)
    assert len(studies([*runs(), *runs(version="0.2.0")])) == 2
    assert len(studies([*runs(), *runs(data_factor=2)])) == 2
    sizes = one([*runs(scenes=("fox",)), *runs(scenes=("bonsai",), data_factor=2)]).settings
    assert sizes["data_factor"] == {"bonsai": 2, "fox": 4}
    fox = runs(scenes=("fox",))
    assert one([*fox, *runs(scenes=("fox",), digest="zz99")]).scenes == (
        "fox (fox0)", "fox (zz99)"
    )  # fmt: skip


def test_parameters_and_profiles_are_variants_of_their_own():
    """But what a plan always asks of methods that look at photographs is no part of a name."""
    more = [
        run
        for method, changes in (
            ("mls", {"parameters": {"k": 12}}), ("mls", {"profile": "paper"}),
            ("depth", {"parameters": {"hold_out": 8, "cloud.hold_out": 8}}),
            ("depth", {"parameters": {"hold_out": 4}}),
        )
        for run in runs(scenes=("fox",), gains={(method, 8): 0.1}, **changes)
    ]  # fmt: skip
    study = one([*runs(scenes=("fox",), repeats=2), *more])
    assert list(study.seeded) == [
        "linear 8x", "mls 4x", "mls 8x", "mls 8x k=12", "mls 8x (paper)", "depth 8x",
        "depth 8x hold_out=4", "random 8x",
    ]  # fmt: skip
    assert study.description.endswith("splatseed 0.1.0, 2 to 3 repeats")


def test_costs_are_means_over_scenes_and_the_papers_stand_beside():
    table = study_tables.cost_table(one(runs(scenes=("bonsai", "fox"))), "none")
    assert column(table, "Gaussians")["mls 4x"].value == 10_000
    assert column(table, "model, MB")["sfm"].value == pytest.approx(5000 * 59 * 4 / 1e6)
    assert "peak GPU memory, MB" not in table.header
    assert column(table, "paper, training, s (Mip-NeRF360)")[MLS8].value == 1503


def test_reaching_a_target_is_interpolated():
    run = result(30.0)  # rises by 1 dB every 100 steps and 2 s, from 21 at 100
    assert comparisons.reach(run, 24.5) == pytest.approx((450, 9.0 + 0.5))
    assert comparisons.reach(run, 10.0)[0] == 100
    assert comparisons.reach(run, 30.01) == pytest.approx((math.nan, math.nan), nan_ok=True)
    run = result(30.0, upsample_seconds=1.0)  # tests at 2, 4, ... 20 s; 21 dB, 22 dB, ... 30 dB
    scores = [comparisons.psnr_at(run, seconds) for seconds in (2.9, 3.0, 4.0, 99.0)]
    assert scores == pytest.approx([math.nan, 21.0, 21.5, 30.0], nan_ok=True)


ODD = Table(
    "odd",
    "50% of $1 | a_b {x} \\",
    ("scene", "a_b & c"),
    (("<s|c>_#1", Number(-0.0001, 2, 0.5, signed=True, mark="~", bold=True)),),
    ("~ means ±", "math.inf is ∞"),
)


def test_tables_are_written_in_four_kinds(tmp_path):
    write_table(ODD, tmp_path)
    kinds = {path.suffix: path.read_text("utf-8") for path in tmp_path.iterdir()}
    assert kinds.keys() == {".csv", ".md", ".tex", ".html"}
    (row,) = list(csv.DictReader(io.StringIO(kinds[".csv"])))
    assert row == {"scene": "<s|c>_#1", "a_b & c": "-0.0001", "a_b & c se": "0.5",
                   "a_b & c mark": "best ~"}  # fmt: skip
    lines, tex = kinds[".md"].splitlines(), kinds[".tex"]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines[2:5]}) == 1
    assert "**0.00 ± 0.50** ~" in lines[4]
    assert r"50\% of \$1 | a\_b \{x\} \textbackslash{}" in tex
    assert r"\textbf{0.00 $\pm$ 0.50} $\sim$" in tex
    assert tex.count("{") - tex.count(r"\{") == tex.count("}") - tex.count(r"\}")
    assert "<th>&lt;s|c&gt;_#1</th>" in kinds[".html"]
    shown = '<td><strong>0.00 ± 0.50</strong> <span class="mark">~</span></td>'
    assert shown in kinds[".html"]


def _study(noise=0.02, plain=5000, **changes):
    """Two strategies under one budget, of which ``sfm`` makes ``plain``: ``grow`` has 0.3 dB more,
    its seeds take 4 s."""
    strategies, finished = ("default", "grow"), []
    for row in runs(strategies=strategies, noise=noise, seed=3, budget="5000", **changes):
        more = 0.3 if row.spec.arm.strategy == "grow" else 0.0
        seconds, count = (0.0, plain) if row.spec.arm.method == SFM else (4.0, 5000)
        psnr = row.result.psnr + more
        made = result(psnr, upsample_seconds=seconds, num_gaussians=count, lpips=0.25)
        finished.append(Run(row.spec, made))
    return one(finished)


def test_every_arm_stands_beside_one_baseline():
    study = _study()
    compared = compared_arms(study)
    by_label = {each.arm.label: each for each in compared}
    assert (baseline_of(study).label, len(by_label)) == ("sfm + default", 10)
    # levels differ by strategy in what is planted, so only gains within one are known
    within = by_label["mls 8x + default"]
    assert within.gain.mean == pytest.approx(0.5, abs=0.05)
    assert within.gain.verdict == "better"
    assert within.gains["covisible"].mean == pytest.approx(within.gain.mean)
    assert (within.means["lpips"], within.gains["lpips"].mean) == (0.25, 0.0)
    assert (within.runs, within.scenes, within.means["gaussians"]) == (12, study.scenes, 5000)
    assert by_label["random 8x + default"].gain.mean == pytest.approx(-0.4, abs=0.05)
    order = [each.gain.mean for each in compared]
    assert order == sorted(order, reverse=True)
    by_scene = study_tables.scene_arm_table(study, baseline_of(study)).rows
    shown = np.mean([cell.value for cell in dict(zip(by_label, by_scene, strict=True))[
        "mls 8x + default"][2:]])  # fmt: skip
    assert shown == pytest.approx(within.gain.mean)


def test_time_counts_seeding_and_steps_do_not():
    by_label = {each.arm.label: each for each in compared_arms(_study(noise=0.0))}
    base, slower = by_label["sfm + default"], by_label["mls 8x + default"]
    assert [base.gains[name].mean for name in ("in_time", "steps", "seconds")] == [0.0, 0.0, 0.0]
    assert slower.means["seeding"] == 4.0
    assert slower.gains["in_time"].mean < slower.gain.mean
    # The target is 9.5 of 10 dB up.
    assert math.exp(slower.gains["steps"].mean) == pytest.approx(0.95)
    assert math.exp(slower.gains["seconds"].mean) == pytest.approx((0.95 * 20 + 4) / 20)
    assert slower.reached == slower.runs
    never = by_label["random 8x + default"]
    assert (never.gains["steps"], never.gains["seconds"], never.reached) == (None, None, 0)


def test_tables_and_sentences_can_be_read():
    study = _study()
    base = baseline_of(study)
    tables = study_tables.arm_table(study), study_tables.seconds_table(study, base)
    text = "".join(map(to_markdown, tables))
    assert {"co-visible", "LPIPS", "baseline", "90%"} <= set(re.findall(r"[\w-]+%?", text))
    said = " ".join(answer(study))
    for part in ("comes out best", "sfm + default", "seeding counted", "with equal numbers of"):
        assert part in said
    assert "at most 5,000 Gaussians" in study.description
    assert unequal_numbers(study) is None
    study = _study(plain=3000)
    assert "3,000 to 5,000 Gaussians" in unequal_numbers(study)
    assert "--budgets" not in unequal_numbers(study)
    assert "under one budget of Gaussians" in answer(study)[0]


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
    assert says in answer(one(runs(gains=gains, noise=0.0, strategies=("default",))))[0]


def test_a_few_repeats_of_one_scene_are_not_called_chance():
    """Beside it stands the test by the noise of all variants, which two repeats may pass."""
    study = one(runs(scenes=("fox",), strategies=("default",), repeats=2, noise=0.3))
    assert "these two arms' 2 repeats alone do not confirm" in answer(study)[0]


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
    assert comparisons.score_advice(study, "none")["advice"].to_dict() == {
        "fern": "auto", "fox": "auto", "bonsai": "sfm", "treehill": "sfm",
    }  # fmt: skip
    table = study_tables.advice_table(study, "none")
    mean = dict(zip(table.header, table.rows[-1], strict=True))
    assert mean["gain over always sfm"].value == pytest.approx(0.2)
    assert mean["gain over always auto"].value == pytest.approx(0.1)
    assert mean["gain over always mls"].value == pytest.approx(0.4)
    assert "4 of 4 scenes" in table.notes[0]


def test_a_scene_does_not_advise_itself():
    """The one whose points should be left, though there is room, is advised as the others are."""
    odd = comparisons.score_advice(_advised({**SPARSE_GAIN, "odd": (-1.0, 2_000)}), "none").loc[
        "odd"
    ]
    assert odd["advice"] == "auto"
    assert odd["auto"] - odd["sfm"] == pytest.approx(-1.0)


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
    _, changes, _ = study_tables.comparison_tables(comparison)
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
    assert study_tables.comparison_tables(comparison)[1].rows[0][2].text == "(1 run)"


def test_changed_files_and_nothing_finished():
    fox, other = runs(scenes=("fox",)), runs(scenes=("fox",), digest="z")
    assert any("fox is not the same" in each for each in compare(fox, other).notes)
    assert compare(fox, []) is None
