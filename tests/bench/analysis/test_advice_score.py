"""Advice held against a ledger: each scene is advised by the others alone."""

from __future__ import annotations

import dataclasses

import pytest

from splatseed.bench.analysis.arms.advice import advice_table, score_advice
from splatseed.bench.analysis.study import studies
from splatseed.bench.analysis.tables import to_markdown
from splatseed.bench.planning.records import RunRow

from ..planted import result, spec


def _study(room):
    """Scenes by what auto gains on them, and how many seeds a run of sfm begins with of 10,000."""
    rows = []
    for scene, (gain, seeds) in room.items():
        for method, more in (("sfm", 0.0), ("mls", -0.2), ("auto", gain)):
            run = spec(scene, method, 0 if method != "sfm" else 1, cap_max=10_000)
            run = dataclasses.replace(run, arm=dataclasses.replace(run.arm, budget="10000"))
            count = seeds if method == "sfm" else 10_000
            made = result(25.0 + more, num_seeds=count)
            rows.append(RunRow(run, "done", made, started=0.0, finished=25.0))
    (study,) = studies(rows)
    return study


SPARSE_GAIN = {"fern": (0.5, 2_000), "fox": (0.3, 4_000), "bonsai": (-0.3, 10_000),
               "treehill": (-0.1, 10_000)}  # fmt: skip


def test_a_rule_that_holds_is_right_everywhere():
    score = score_advice(_study(SPARSE_GAIN), "none")
    assert {each.scene: each.method for each in score.scenes} == {
        "fern": "auto", "fox": "auto", "bonsai": "sfm", "treehill": "sfm",
    }  # fmt: skip
    assert score.right == 4
    assert score.gain_over("sfm") == pytest.approx(0.2)
    assert score.gain_over("auto") == pytest.approx(0.1)
    assert score.gain_over("mls") == pytest.approx(0.4)


def test_a_scene_does_not_advise_itself():
    """The one whose points should be left, though there is room, is advised as the others are."""
    score = score_advice(_study({**SPARSE_GAIN, "odd": (-1.0, 2_000)}), "none")
    odd = next(each for each in score.scenes if each.scene == "odd")
    assert odd.method == "auto"
    assert odd.regret == pytest.approx(1.0)
    assert score.right < len(score.scenes)


def test_the_table_says_what_advice_is_worth():
    text = to_markdown(advice_table(score_advice(_study(SPARSE_GAIN), "none")))
    assert "Within 0.1 dB of the best arm on 4 of 4 scenes" in text
    assert "gain over always mls" in text
