"""Scores must be what their definitions say, in any unit of length."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import PointCloudError
from splatseed.seeding.diagnostics import far_share, local_spacing, measure, spacing
from splatseed.synthetic import SHAPES


def _brute_spacing(xyz):
    distances = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    return np.mean([np.sort(row[row > 0])[:6].mean() for row in distances])


def test_spacing_is_the_mean_over_six_neighbours(rng):
    xyz = rng.normal(size=(300, 3))
    assert spacing(xyz) == pytest.approx(_brute_spacing(xyz))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_spacing_scales_with_the_cloud(rng, scale):
    xyz = rng.normal(size=(200, 3))
    assert spacing(scale * xyz) == pytest.approx(scale * spacing(xyz))


def test_duplicates_and_nan_points_are_no_neighbours():
    pair = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    doubled = np.concatenate([pair, pair, [[np.nan, 0, 0]]])
    assert spacing(doubled) == pytest.approx(1.0)
    assert local_spacing(np.concatenate([pair, pair])).tolist() == [1.0] * 4


@pytest.mark.parametrize("xyz", [np.empty((0, 3)), np.ones((1, 3)), np.ones((9, 3))])
def test_a_cloud_without_a_spacing_is_refused(xyz):
    with pytest.raises(PointCloudError, match="two distinct finite points"):
        spacing(xyz)


def test_measure_on_a_plane_moved_off_by_half_a_spacing(rng):
    plane = SHAPES["plane"]()
    originals = plane.sample(2000, rng)
    h = spacing(originals)
    new = plane.sample(1000, rng) + 0.5 * h * plane.frame[2]
    whole = np.concatenate([originals, new])
    score = measure(new, whole, plane, plane.sample(4000, rng), h)
    assert score.error == pytest.approx(0.5)
    assert score.p95 == pytest.approx(0.5)
    assert score.share_far == 0


def test_more_points_cover_more_and_outliers_are_far(rng):
    sphere = SHAPES["sphere"]()
    originals, extra = sphere.sample(500, rng), sphere.sample(1500, rng)
    samples = sphere.sample(5000, rng)
    h = spacing(originals)
    before = measure(originals, originals, sphere, samples, h)
    after = measure(extra, np.concatenate([originals, extra]), sphere, samples, h)
    assert after.coverage < 0.6 * before.coverage
    assert before.share_far == after.share_far == 0
    astray = np.concatenate([extra[:900], 3 * extra[900:1000]])
    score = measure(astray, np.concatenate([originals, astray]), sphere, samples, h)
    assert score.share_far == pytest.approx(0.1)


@pytest.mark.parametrize(("num", "h"), [(0, 1.0), (5, 0.0), (5, np.nan)])
def test_measure_refuses_what_it_cannot_measure(num, h):
    with pytest.raises(PointCloudError, match="spacing above zero"):
        measure(np.zeros((num, 3)), np.zeros((num, 3)), SHAPES["sphere"](), np.ones((3, 3)), h)


def test_far_is_three_local_spacings_of_the_nearest_original():
    near = np.stack(np.meshgrid(*[np.arange(4.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    far = 100 * near + [1000.0, 0, 0]
    originals = np.concatenate([near, far])
    height = 2.9 * local_spacing(originals).min()
    new = near + np.array([0, 0, height])
    assert far_share(originals, new) == 0
    assert far_share(originals, near + np.array([0, 0, 9.0])) == 1
    assert (
        far_share(originals, far + np.array([0, 0, 9.0])) == 0
    )  # the same height over sparser points


def test_far_share_of_odd_clouds():
    one = np.zeros((1, 3))
    assert far_share(one, np.empty((0, 3))) == 0
    assert far_share(one, one) == 0
    assert far_share(one, one + 1) == 1
    assert far_share(one, np.array([[0.0, 0, 0], [np.nan, 0, 0]])) == 0.5
    with pytest.raises(PointCloudError, match="finite original points"):
        far_share(np.full((2, 3), np.nan), one)
