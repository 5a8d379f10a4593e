"""Spacing and geometry scores against brute force and known surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import PointCloudError
from splatseed.seeding.geometry_score import far_share, mean_spacing, measure
from splatseed.synthetic import SHAPES


def _brute_spacing(xyz):
    """Mean distance of every distinct point to its 6 nearest, by all pairs."""
    distinct = np.unique(np.asarray(xyz, np.float64), axis=0)
    distances = np.linalg.norm(distinct[:, None] - distinct, axis=2)
    return np.sort(distances, axis=1)[:, 1:7].mean(axis=1)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_spacing_is_the_mean_over_six_neighbours_in_any_unit(scale, rng):
    xyz = rng.normal(size=(300, 3))
    assert mean_spacing(scale * xyz) == pytest.approx(scale * _brute_spacing(xyz).mean())
    twice = np.array([[0.0, 0, 0], [scale, 0, 0], [0, 0, 0], [scale, 0, 0], [np.nan, 0, 0]])
    assert mean_spacing(twice) == scale
    often = scale * np.repeat(xyz, 8, axis=0)
    assert mean_spacing(often) == pytest.approx(mean_spacing(scale * xyz))


def test_points_near_a_plane_and_beyond_a_sphere_are_measured(rng):
    plane, sphere = SHAPES["plane"](), SHAPES["sphere"]()
    originals = plane.sample(2000, rng)
    h = mean_spacing(originals)
    new = plane.sample(1000, rng) + 0.5 * h * plane.frame[2]
    full = np.concatenate([originals, new])
    score = measure(new, full, plane, plane.sample(4000, rng), h)
    assert (score.error, score.p95) == (pytest.approx(0.5), pytest.approx(0.5))
    assert score.share_far == 0
    originals, extra = sphere.sample(500, rng), sphere.sample(1500, rng)
    samples, h = sphere.sample(5000, rng), mean_spacing(originals)
    before = measure(originals, originals, sphere, samples, h)
    after = measure(extra, np.concatenate([originals, extra]), sphere, samples, h)
    assert after.coverage < 0.6 * before.coverage
    stray = np.concatenate([extra[:900], 3 * extra[900:1000]])
    score = measure(stray, np.concatenate([originals, stray]), sphere, samples, h)
    assert score.share_far == pytest.approx(0.1)


def test_far_is_three_local_spacings_of_the_nearest_original():
    near = np.stack(np.meshgrid(*[np.arange(4.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    far = 100 * near + [1000.0, 0, 0]
    originals, up = np.concatenate([near, far]), np.array([0, 0, 1.0])
    assert far_share(originals, near + 2.9 * up) == 0
    assert far_share(originals, near + 9 * up) == 1
    assert far_share(originals, far + 9 * up) == 0  # the same height over sparser points


def test_far_share_of_tiny_clouds():
    one = np.zeros((1, 3))
    assert far_share(one, np.empty((0, 3))) == 0
    assert far_share(one, one) == 0
    assert far_share(one, one + 1) == 1
    assert far_share(one, np.array([[0.0, 0, 0], [np.nan, 0, 0]])) == 0.5
    assert far_share(one, np.repeat([[0.0, 0, 0], [1.0, 0, 0]], 40_000, axis=0)) == (
        pytest.approx(0.5, abs=0.02)  # a sample of them
    )


def test_clouds_without_spacing_are_refused():
    for xyz in (np.empty((0, 3)), np.ones((1, 3)), np.ones((9, 3))):
        with pytest.raises(PointCloudError):
            mean_spacing(xyz)
    with pytest.raises(PointCloudError):
        far_share(np.full((2, 3), np.nan), np.zeros((1, 3)))
