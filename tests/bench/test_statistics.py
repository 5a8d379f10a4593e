"""Differences against SciPy, and how often they claim what is there and what is not."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy

from splatseed.bench.statistics import (
    Difference,
    adjusted,
    difference,
    holm,
    over_scenes,
    paired_differences,
    pooled_noise,
    these_scenes,
)


def plant(rng, *, scenes, arms, repeats, gain=0.0, noise=0.06, spread=0.0):
    """Scores [scene, arm, repeat]: scenes and repeats differ, arm 1 gains, not alike on scenes."""
    level = rng.uniform(20, 35, (scenes, 1, 1))
    repeat = 0.05 * rng.standard_normal((scenes, 1, repeats))
    effect = np.zeros((scenes, arms, 1))
    effect[:, 1:] += spread * rng.standard_normal((scenes, arms - 1, 1))
    effect[:, 1] += gain
    return level + repeat + effect + noise * rng.standard_normal((scenes, arms, repeats))


def test_two_arms_are_scipys_paired_t_test(rng):
    values = plant(rng, scenes=1, arms=2, repeats=5)[0]
    ours = paired_differences(values)[0]
    expected = scipy.stats.ttest_rel(values[1], values[0])
    assert ours.p == pytest.approx(expected.pvalue, rel=1e-9)
    assert ours.se == pytest.approx(scipy.stats.sem(values[1] - values[0]))
    assert ours.df == 4
    assert ours.interval() == pytest.approx(tuple(expected.confidence_interval(0.95)))


def test_noise_is_that_of_the_analysis_of_variance(rng):
    values = plant(rng, scenes=1, arms=6, repeats=3)[0]
    rest = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    noise, df = pooled_noise(values)
    assert df == 5 * 2
    assert noise == pytest.approx(math.sqrt((rest**2).sum() / df))


def test_missing_runs_are_left_out(rng):
    values = plant(rng, scenes=1, arms=4, repeats=3)[0]
    values[2, 1] = values[3, :] = np.nan
    first, second, third = paired_differences(values)
    assert third is None
    assert second.n == 2
    assert second.mean == pytest.approx((values[2] - values[0])[[0, 2]].mean())
    assert first.df == 4 - 1  # 8 runs less 3 arms and 3 repeats, of which one is the others' level
    alone, df = pooled_noise(values[[0, 3]])
    assert math.isnan(alone)
    assert df == 0


def test_one_repeat_claims_nothing(rng):
    differences = adjusted(paired_differences(plant(rng, scenes=1, arms=3, repeats=1)[0]))
    assert all(each.verdict == "too few to tell" for each in differences)
    assert all(math.isnan(bound) for bound in (differences[0].se, *differences[0].interval()))
    assert differences[0].caveat == " (1 repeat: too few to tell)"


def test_runs_without_any_noise():
    same = paired_differences(np.array([[20.1, 30.2], [20.1, 30.2], [20.4, 30.5]]))
    assert [each.p for each in same] == [1.0, 0.0]
    assert same[1].interval() == pytest.approx((0.3, 0.3))


def test_over_scenes_is_scipys_one_sample_t_test(rng):
    means = rng.standard_normal(7)
    ours, expected = over_scenes(means), scipy.stats.ttest_1samp(means, 0.0)
    assert ours.p == pytest.approx(expected.pvalue)
    assert ours.df == 6
    assert math.isnan(over_scenes([0.3]).p)


def test_holm_step_by_step(rng):
    p = rng.random(6) ** 3
    order = np.argsort(p)
    expected = np.minimum(np.maximum.accumulate((6 - np.arange(6)) * p[order]), 1)
    assert np.array(holm(p))[order] == pytest.approx(expected)
    with_unknown = holm([0.02, math.nan, 0.03])
    assert with_unknown[::2] == (0.04, 0.04)
    assert math.isnan(with_unknown[1])
    assert holm([]) == ()


def test_verdicts():
    for mean, p, df, expected in (
        (1.0, 0.01, 3, "better"), (-1.0, 0.01, 3, "worse"), (1.0, 0.2, 3, "within noise"),
        (1.0, 0.2, 2, "too few to tell"), (-1.0, 0.001, 2, "too few to tell"),
    ):  # fmt: skip
        assert adjusted([Difference(mean, 0.1, df, 4, p)])[0].verdict == expected
    assert adjusted([None]) == (None,)


def test_an_interval_excludes_0_exactly_if_the_difference_is_a_claim(rng):
    """-2.264 ± 0.135 from 2 of 3 pairs is p = 0.038, of a family of two 0.076: no claim."""
    two = adjusted([difference(-2.264, 0.135, 1, 2), difference(0.1, 0.135, 1, 2)])
    assert [each.verdict for each in two] == ["too few to tell"] * 2
    assert all(math.isnan(bound) for bound in two[0].interval())
    seen = set()
    for _ in range(50):
        df = int(rng.integers(1, 9))
        family = [difference(m, 1.0, df, df + 1) for m in 4 * rng.standard_normal(5)]
        for each in adjusted(family):
            low, high = each.interval()
            claim = each.verdict in {"better", "worse"}
            assert claim == (low > 0 or high < 0)
            assert claim == (each.caveat == "")
            seen.add(each.verdict)
    assert len(seen) == 4


def claims(values):
    """Whether anything is claimed on one scene, of these scenes, and of scenes like these."""
    scenes = [paired_differences(each) for each in values]
    single = adjusted([each for scene in scenes for each in scene])
    arms = list(zip(*scenes, strict=True))
    these = adjusted([these_scenes(arm) for arm in arms])
    like = adjusted([over_scenes([each.mean for each in arm]) for arm in arms])
    return [
        [each.verdict in {"better", "worse"} for each in family] for family in (single, these, like)
    ]


SIMULATIONS = 300


def rates(rng, judged, **planted):
    """How often each family claims anything that ``judged`` picks of it."""
    claimed = [claims(plant(rng, **planted)) for _ in range(SIMULATIONS)]
    return [np.mean([judged(family) for family in each]) for each in zip(*claimed, strict=True)]


def test_a_null_is_claimed_at_most_at_the_stated_rate(rng):
    """5% of tables may claim anything at all; 300 tables stray by 1.3 points: 9% is 3 sigma."""
    assert max(rates(rng, any, scenes=5, arms=6, repeats=3)) < 0.09


def test_gains_that_only_vary_by_scene_are_not_claimed_for_scenes_like_these(rng):
    """The mean gain is 0 but each scene has its own: runs as samples claim it far too often."""
    planted = {"scenes": 5, "arms": 2, "repeats": 4, "noise": 0.05, "spread": 0.3}
    assert rates(rng, any, **planted)[2] < 0.09
    runs = [
        scipy.stats.ttest_1samp(np.diff(plant(rng, **planted), axis=1).ravel(), 0).pvalue < 0.05
        for _ in range(SIMULATIONS)
    ]
    assert np.mean(runs) > 0.25


def test_a_planted_tenth_of_a_decibel_is_found(rng):
    """Noise of 0.06 dB a run, three repeats, five scenes, among five methods."""
    planted = {"arms": 6, "repeats": 3, "gain": 0.1, "spread": 0.01}
    _, these, like = rates(rng, lambda family: family[0], scenes=5, **planted)
    assert these > 0.9
    assert like > 0.4  # four degrees of freedom, five comparisons
    assert rates(rng, lambda family: family[0], scenes=9, **planted)[2] > 0.9


def test_a_noisier_arm_alone_strays_little(rng):
    """The pooled noise takes all arms as equal; one of six at twice the noise is still held."""

    def null():
        values = plant(rng, scenes=1, arms=6, repeats=3)[0]
        values[5] += 0.06 * math.sqrt(3) * rng.standard_normal(3)
        return paired_differences(values)[4].p < 0.05

    assert np.mean([null() for _ in range(SIMULATIONS)]) < 0.16
