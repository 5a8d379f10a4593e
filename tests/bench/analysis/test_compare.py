"""Two ledgers: what changed is found, what did not is not, what only one has is told."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from splatseed.bench.analysis.compare import change_table, compare, only_table, settings_table
from splatseed.bench.analysis.study import BASELINE, Variant
from splatseed.bench.planning.records import SFM
from splatseed.bench.running.ledger import LEDGER, Ledger
from splatseed.cli import main

from ..planted import GAINS, rows

MLS8 = Variant("mls", ratio=8.0)
BETTER = {**GAINS, ("mls", 8): 0.8}
"""In which mls 8x gains 0.3 dB more than in ``GAINS``."""


def change(comparison, scene, variant):
    return next(c.difference for c in comparison.changes if (c.scene, c.arm[1]) == (scene, variant))


def mean(comparison, variant):
    return next(c.difference for c in comparison.means if c.arm[1] == variant)


def test_a_planted_change_is_found_and_nothing_else():
    comparison = compare(rows(), rows(gains=BETTER, seed=1, version="0.2.0"))
    assert comparison.settings == (("version", "0.1.0", "0.2.0"),)
    assert change(comparison, "fox", MLS8).mean == pytest.approx(0.3, abs=0.12)
    assert mean(comparison, MLS8).verdict == "better"
    marked = [row[1].text for row in change_table(comparison).rows if row[-1].mark == "*"]
    assert marked == ["mls 8x"]
    others = [c.difference.verdict for c in comparison.means if c.arm[1] != MLS8]
    assert set(others) == {"within noise"}


def test_one_arm_is_welchs_test():
    a, b = rows(scenes=("fox",), gains={(SFM, 1): 0.0}, repeats=4), rows(
        scenes=("fox",), gains={(SFM, 1): 0.1}, repeats=6, seed=1, noise=0.2
    )  # fmt: skip
    scores = [[row.result.psnr for row in each] for each in (a, b)]
    expected = stats.ttest_ind(scores[1], scores[0], equal_var=False)
    difference = change(compare(a, b), "fox", BASELINE)
    assert difference.p == pytest.approx(expected.pvalue)
    assert difference.df == pytest.approx(expected.df)
    assert difference.mean == pytest.approx(np.mean(scores[1]) - np.mean(scores[0]))


def test_no_change_is_claimed_at_most_at_the_stated_rate():
    """Repeats have effects of their own here, which all arms of a scene share."""
    claimed = 0
    for seed in range(100):
        comparison = compare(rows(seed=seed), rows(seed=1000 + seed))
        claimed += any(c.difference.verdict != "within noise" for c in comparison.means)
    assert claimed <= 15


def test_equal_ledgers_have_equal_runs():
    comparison = compare(rows(), rows())
    assert comparison.same_runs == len(rows())
    assert not comparison.settings
    assert {c.difference.mean for c in comparison.changes} == {0.0}


def test_what_only_one_has():
    some = [r for r in rows() if r.spec.scene != "fox" and r.spec.arm.label != "mls 4x"]
    comparison = compare(some, [r for r in rows() if r.spec.arm.label != "random 8x"])
    assert {place[1:] for place in comparison.only_b} >= {("fox", MLS8)}
    assert {place[2].label for place in comparison.only_a} == {"random 8x"}
    shown = {tuple(cell.text for cell in row) for row in only_table(comparison).rows}
    assert ("A", "none", "bonsai", "random 8x") in shown
    assert ("B", "none", "fox", "mls 4x") in shown


def test_single_runs_claim_nothing():
    comparison = compare(rows(repeats=1), rows(repeats=1, seed=1))
    assert {c.difference.verdict for c in comparison.changes} == {"unknown"}
    assert math.isnan(comparison.means[0].difference.se)
    assert "(1 run)" in change_table(comparison).rows[0][2].text


def test_of_several_sets_those_that_fit_are_compared():
    both = [*rows(max_steps=2000, scenes=("fox",)), *rows()]
    comparison = compare(both, rows(max_steps=2000, seed=3))
    assert not comparison.settings
    assert {c.scene for c in comparison.changes} == {"fox"}
    assert settings_table(compare(rows(), rows(max_steps=2000))).rows[0][1].text == "1000"


def test_changed_files_are_told():
    other = [
        dataclasses.replace(r, spec=dataclasses.replace(r.spec, scene_digest="z"))
        for r in rows(scenes=("fox",))
    ]
    assert compare(rows(scenes=("fox",)), other).content == ("fox",)


def test_nothing_finished_is_nothing_to_compare():
    assert compare(rows(), []) is None


def bench(folder, finished):
    folder.mkdir()
    ledger = Ledger.open(folder / LEDGER)
    ledger.add([row.spec for row in finished])
    for row in finished:
        ledger.finish(row.spec.key, row.result)
    return str(folder)


def test_the_command(tmp_path, capsys):
    a = bench(tmp_path / "a", rows(scenes=("fox",)))
    b = bench(tmp_path / "b", rows(scenes=("fox", "fern"), gains=BETTER, seed=1))
    main(["bench", "compare", a, b, "-o", str(tmp_path / "out")])
    said = " ".join(capsys.readouterr().out.split())
    assert "Changes from A to B" in said
    assert "All settings are the same." in said
    assert "What only one of them has" in said
    assert (tmp_path / "out" / "changes.csv").is_file()
    with pytest.raises(SystemExit) as stop:
        main(["bench", "compare", a, b, "-o", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert "found an earlier output. Pass --overwrite" in " ".join(capsys.readouterr().err.split())
    main(["bench", "compare", a, b, "-o", str(tmp_path / "out"), "--overwrite"])
    capsys.readouterr()
    empty = bench(tmp_path / "c", [])
    with pytest.raises(SystemExit) as stop:
        main(["bench", "compare", a, empty])
    assert stop.value.code == 2
    assert "expected finished runs in both" in " ".join(capsys.readouterr().err.split())
