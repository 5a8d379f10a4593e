"""Which points a run starts from."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.pointcloud import PointCloud
from splatseed.train.seeds import seeds_digest, usable_seeds
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


@pytest.fixture
def known(points) -> PointCloud:
    """The points with a size that follows from the position, normals of some, and confidence."""
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    normals[::3] = np.nan
    sizes = np.abs(points.xyz[:, 0])
    return points.replace(normals=normals, sizes=sizes, confidence=np.ones(len(points)))


def test_of_what_is_known_only_what_is_asked_for_has_a_part(known, points):
    begun = {
        names: usable_seeds(known, TrainSettings(**dict.fromkeys(names, True)), print)
        for names in ((), ("seed_sizes",), ("seed_normals",), ("seed_sizes", "seed_normals"))
    }
    assert [sorted(seeds.attributes) for seeds in begun.values()] == [
        *([], ["sizes"], ["normals"], ["normals", "sizes"])
    ]
    digests = [seeds_digest(seeds) for seeds in begun.values()]
    assert len(set(digests)) == 4
    assert digests[0] == seeds_digest(points)


def test_what_is_known_follows_the_points_that_stay(known):
    settings = TrainSettings(cap_max=55, seed_sizes=True)
    seeds = usable_seeds(known, settings, lambda _: None)
    np.testing.assert_array_equal(seeds.sizes, np.abs(seeds.xyz[:, 0]))


def test_asking_for_what_is_not_known_is_told(points):
    notes: list[str] = []
    unknown = points.replace(sizes=np.full(len(points), np.nan))
    usable_seeds(unknown, TrainSettings(seed_sizes=True, seed_normals=True), notes.append)
    assert [note.split()[0] for note in notes] == ["--seed-sizes", "--seed-normals"]
