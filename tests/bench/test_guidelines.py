"""Guidelines: planted ones are found, chance ones are not; descriptors of shapes that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy import stats

pytest.importorskip("pandas", reason="studies need pandas")

from splatseed.bench.comparisons import gains
from splatseed.bench.guidelines import (
    DESCRIPTIONS,
    describe,
    guideline_table,
    guidelines,
    rank_correlation,
    winner_table,
)
from splatseed.bench.plan import SFM
from splatseed.bench.study import studies
from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource

from .planted import runs


def plant(rng, count, slope):
    """Scenes whose gain from mls grows with planarity, all else at random."""
    described, finished = {}, []
    for i in range(count):
        described[f"scene{i:02}"] = each = dict(zip(DESCRIPTIONS, rng.random(8), strict=True))
        own = {(SFM, 1): 0.0, ("linear", 8): 0.0, ("mls", 8): slope * each["planarity"]}
        finished += runs(scenes=(f"scene{i:02}",), gains=own, repeats=2, seed=i, noise=0.02)
    (study,) = studies(finished)
    return study, gains(study, "none"), described


def test_exact_p_is_that_of_all_orders(rng):
    x, y = rng.random(6), rng.random(6)
    x[1] = x[0]  # ties too
    expected = stats.permutation_test(
        (x,), lambda order: stats.spearmanr(order, y).statistic, permutation_type="pairings",
        n_resamples=math.inf,
    )  # fmt: skip
    assert rank_correlation(x, y) == pytest.approx((expected.statistic, expected.pvalue))
    x, y = rng.random(20), rng.random(20)  # many scenes are SciPy's approximation
    assert rank_correlation(x, y) == pytest.approx(tuple(stats.spearmanr(x, y)))


def test_a_planted_guideline_is_found(rng):
    derived = guidelines(*plant(rng, 14, 2.0))
    first = derived.iloc[0]
    assert (first.descriptor, first.method, first.adjusted <= 0.05) == ("planarity", "mls", True)
    assert first.sentence == "Scenes with more planarity gain more from mls."
    assert first.agree >= 12


def test_chance_is_not_called_support(rng):
    claimed = sum((guidelines(*plant(rng, 9, 0.0))["adjusted"] <= 0.05).any() for _ in range(20))
    assert claimed <= 3


def test_few_scenes_say_that_they_are_few(rng):
    derived = guidelines(*plant(rng, 5, 2.0))
    assert not (derived["adjusted"] <= 0.05).any()
    assert "only from 6 scenes on, and here" in guideline_table(derived, "none").notes[0]
    assert "No guideline" in guideline_table(guidelines(*plant(rng, 2, 2.0)), "none").notes[0]


def test_scenes_without_descriptors_are_left_out(rng):
    study, gained, described = plant(rng, 6, 2.0)
    del described["scene00"]
    described["scene01"]["planarity"] = math.nan
    derived = guidelines(study, gained, described)
    counts = dict(zip(derived["descriptor"], derived["scenes"], strict=True))
    assert (counts["planarity"], counts["texture"]) == (4, 5)
    assert guideline_table(guidelines(study, gained, {}), "none").rows == []
    assert math.isnan(winner_table(gained, described).rows[0][4].value)


def cloud(xyz):
    return PointCloud(xyz.astype(np.float32), np.zeros((len(xyz), 3), np.uint8))


def plane(rng, n=2000):
    return np.column_stack([rng.uniform(-1, 1, (n, 2)), np.zeros(n)])


def test_local_shape_against_a_slow_reference(rng):
    xyz = rng.standard_normal((60, 3)).astype(np.float32).astype(float)
    total = []
    for point in xyz:
        near = xyz[np.argsort(np.linalg.norm(xyz - point, axis=1))[:17]]
        l3, l2, l1 = np.linalg.eigvalsh(np.cov(near.T, bias=True))
        total.append(((l2 - l3) / l1, (l1 - l2) / l1, l3 / l1, l3 / (l1 + l2 + l3)))
    described = describe(Scene(cloud(xyz)))
    values = [described[n] for n in ("planarity", "linearity", "scattering", "curvature")]
    assert values == pytest.approx(np.mean(total, axis=0), rel=1e-5)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    there = describe(Scene(cloud(50 * xyz @ turn + 7)))  # units and frames do not matter
    assert there == pytest.approx(described, rel=1e-3, nan_ok=True)


def view(folder, xyz, pixels, name="a.png"):
    """A camera 4 above the origin that looks down on it, and its photograph."""
    camera = Intrinsics(1, "PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
    pose = np.diag([1.0, -1.0, -1.0])
    image = Image(name, 1, camera, quat_from_rotation(pose), np.array([0.0, 0.0, 4.0]))
    PilImage.fromarray(pixels).save(folder / name)
    source = SceneSource("colmap", folder, folder, image_dir=folder)
    return Scene(cloud(xyz), (image,), (camera,), source=source)


def test_gaps_empty_area_and_texture_are_those_of_the_views(tmp_path, rng):
    xyz = plane(rng, 500)
    ramp = np.ascontiguousarray(np.broadcast_to(np.arange(64)[None, :, None] * 4, (48, 64, 3)))
    described = describe(view(tmp_path, xyz, ramp.astype(np.uint8)))
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    spacing = np.sort(distance, axis=1)[:, 1:7].mean(axis=1)
    # All is 4 away: f h / z over the longer side.
    assert described["gap"] == pytest.approx(np.median(spacing) * 60 / 4 / 64, rel=1e-3)
    assert 0.4 < described["empty"] < 0.8  # the square fills 30 x 30 of 64 x 48 pixels
    # 64 pixels are made 320: a fifth of 4 / 255 a pixel.
    assert described["texture"] == pytest.approx(4 / 5 / 255, rel=0.1)


def test_added_points_are_not_described_and_few_are_refused(rng):
    xyz = plane(rng, 300)
    both = np.concatenate([xyz, rng.standard_normal((900, 3))]).astype(np.float32)
    source = np.repeat(np.array([0, 4], np.uint8), [300, 900])
    added = PointCloud(both, np.zeros((1200, 3), np.uint8), source)
    assert describe(Scene(added)) == pytest.approx(describe(Scene(cloud(xyz))), nan_ok=True)
    with pytest.raises(PointCloudError, match="at least 4"):
        describe(Scene(cloud(np.ones((20, 3)))))
