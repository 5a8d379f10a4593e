"""Which points a run starts from."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.pointcloud import PointCloud
from splatseed.train.seeds import usable_seeds
from splatseed.train.settings import TrainSettings

ORIGINALS, NEW = 40, 60


@pytest.fixture
def points(rng) -> PointCloud:
    xyz = rng.normal(size=(ORIGINALS + NEW, 3))
    source = np.repeat([0, 4], [ORIGINALS, NEW]).astype(np.uint8)
    return PointCloud(xyz, np.zeros((ORIGINALS + NEW, 3), np.uint8), source)


def thinned(points: PointCloud, cap: int, seed: int = 0) -> tuple[PointCloud, list[str]]:
    notes: list[str] = []
    settings = TrainSettings(cap_max=cap, seed=seed)
    return usable_seeds(points, settings, notes.append), notes


def test_all_originals_stay_while_they_fit(points):
    seeds, notes = thinned(points, 70)
    assert len(seeds) == 70
    assert np.array_equal(seeds.xyz[:ORIGINALS], points.xyz[:ORIGINALS])
    told = "100 seeds were thinned out at random to --cap-max 70, 40 of them originals."
    assert notes == [f"{told} They leave densification no room."]
    usable_seeds(points, TrainSettings(cap_max=70, strategy="none"), notes.append)
    assert notes[1:] == [told]


def test_a_cap_below_the_originals_keeps_nothing_else(points):
    seeds, _ = thinned(points, 15)
    assert (seeds.num_original, len(seeds)) == (15, 15)


def test_which_stay_depends_on_the_seed_alone(points):
    first, again, other = (thinned(points, 70, seed)[0].xyz for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_every_new_point_is_as_likely_to_stay(points):
    counts = np.zeros(NEW)
    for seed in range(200):
        seeds, _ = thinned(points, 70, seed)
        counts += np.isin(points.xyz[ORIGINALS:, 0], seeds.xyz[:, 0])
    assert counts.sum() == 200 * 30
    assert 60 < counts.min() < 100 < counts.max() < 140  # binomial of 200 and 1/2, five deviations


def test_points_that_are_not_finite_are_left_out_and_told_of(points):
    xyz = points.xyz.copy()
    xyz[3] = np.nan
    seeds, notes = thinned(points.replace(xyz=xyz), 1000)
    assert len(seeds) == ORIGINALS + NEW - 1
    assert notes == ["1 points without finite coordinates were left out."]
