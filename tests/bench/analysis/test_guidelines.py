"""Guidelines: planted ones are found, chance ones are not called supported."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from splatseed.bench.analysis.descriptors import Descriptors
from splatseed.bench.analysis.gains import gains
from splatseed.bench.analysis.guidelines import (
    Guideline,
    fewest_scenes,
    guideline_table,
    guidelines,
    rank_correlation,
    scene_table,
    verdict,
    winner_table,
)
from splatseed.bench.analysis.study import studies
from splatseed.bench.analysis.tables import to_markdown
from splatseed.bench.planning.records import SFM

from ..planted import rows

METHODS = {(SFM, 1): 0.0, ("linear", 8): 0.0, ("mls", 8): 0.0}


def random_scene(rng):
    return Descriptors(*rng.random(8))


def plant(rng, count, slope):
    """Scenes whose gain from mls grows with planarity, all else at random."""
    described = {f"scene{i:02}": random_scene(rng) for i in range(count)}
    finished = []
    for i, (scene, each) in enumerate(described.items()):
        own = {**METHODS, ("mls", 8): slope * each.planarity}
        finished += rows(scenes=(scene,), gains=own, repeats=2, seed=i, noise=0.02)
    (study,) = studies(finished)
    return gains(study, "none"), described


def test_exact_p_is_that_of_all_orders(rng):
    x, y = rng.random(6), rng.random(6)
    x[1] = x[0]  # ties too
    rho, p = rank_correlation(x, y)

    def statistic(order):
        return stats.spearmanr(order, y).statistic

    expected = stats.permutation_test((x,), statistic, permutation_type="pairings",
                                      n_resamples=math.inf)  # fmt: skip
    assert rho == pytest.approx(statistic(x))
    assert p == pytest.approx(expected.pvalue)


def test_many_scenes_are_scipys_approximation(rng):
    x, y = rng.random(20), rng.random(20)
    assert rank_correlation(x, y) == pytest.approx(tuple(stats.spearmanr(x, y)))


def test_a_planted_guideline_is_found(rng):
    derived = guidelines(*plant(rng, 14, 2.0))
    first = derived[0]
    assert (first.descriptor, first.method, first.supported) == ("planarity", "mls", True)
    assert first.sentence == "Scenes with more planarity gain more from mls."
    assert first.agree >= 12
    assert verdict(derived).startswith("Supported by 14 scenes")


def test_chance_is_not_called_support(rng):
    claimed = sum(any(g.supported for g in guidelines(*plant(rng, 9, 0.0))) for _ in range(20))
    assert claimed <= 3


def test_few_scenes_say_that_they_are_few(rng):
    derived = guidelines(*plant(rng, 5, 2.0))
    assert not any(each.supported for each in derived)
    said = verdict(derived)
    assert "supports no guideline" in said
    assert "only from 6 scenes on, and here there are 5" in said
    assert "No guideline can be looked for" in verdict(guidelines(*plant(rng, 2, 2.0)))


@pytest.mark.parametrize("comparisons", [1, 7, 56])
def test_fewest_scenes_is_where_a_perfect_order_counts(comparisons):
    n = fewest_scenes(comparisons)
    perfect = rank_correlation(np.arange(n), np.arange(n))[1]
    less = rank_correlation(np.arange(n - 1), np.arange(n - 1))[1]
    assert perfect * comparisons <= 0.05
    assert less * comparisons > 0.05 or n == 3


def test_scenes_without_descriptors_are_left_out(rng):
    gained, described = plant(rng, 6, 2.0)
    del described["scene00"]
    described["scene01"] = Descriptors(math.nan, *[0.5] * 7)
    counts = {each.descriptor: each.scenes for each in guidelines(gained, described)}
    assert (counts["planarity"], counts["texture"]) == (4, 5)
    assert guidelines(gained, {}) == ()


def test_tables_of_guidelines_scenes_and_winners(rng):
    gained, described = plant(rng, 4, 2.0)
    table = guideline_table(guidelines(gained, described), "none")
    assert len(table.rows) == 10
    assert "supports no guideline" in to_markdown(table)
    del described["scene00"]
    assert len(scene_table(described).rows) == 3
    winners = winner_table(gained, described)
    assert {row[1].text for row in winners.rows} <= {"mls 8x", "linear 8x", "sfm"}
    assert winners.rows[0][4].value is None
    assert guideline_table((), "none").rows == ()


def test_fewer_reads_less():
    assert "gain less from" in Guideline("empty", "mls", -0.5, 0.1, 3, 5).sentence
