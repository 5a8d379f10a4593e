"""Points are found again where a photograph was moved to."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from splatseed.checkup._kernels import find_points


@pytest.mark.parametrize(("right", "down"), [(2.0, -1.0), (0.4, 0.0), (-3.0, 2.75)])
def test_the_place_is_that_of_the_moved_photograph(rng, right, down):
    first = gaussian_filter(rng.uniform(0, 255, (60, 80)), 1.5)
    second = shift(first, (down, right), order=3, mode="nearest")
    uv = rng.integers((20, 20), (60, 40), (20, 2)) + 0.5  # the centres of pixels
    # The identity carries every pixel over to itself.
    places = find_points(first, second, uv, np.ones(20), np.eye(3), np.zeros(3), 3, 4, 0.1)
    np.testing.assert_allclose(places[:, :2], np.tile([right, down], (20, 1)), atol=0.5)
    np.testing.assert_allclose(np.median(places[:, :2], axis=0), [right, down], atol=0.15)
    assert (places[:, 2] > 0.9).all()


def test_the_plane_of_a_point_moves_with_its_depth(rng):
    """Half as deep, points move twice as far: x_j = x_i + t / z."""
    first = gaussian_filter(rng.uniform(0, 255, (60, 80)), 1.5)
    second = shift(first, (0, 6), order=3, mode="nearest")
    uv, t = np.array([[40.0, 30.0], [40.0, 30.0]]), np.array([12.0, 0, 0])
    places = find_points(first, second, uv, np.array([2.0, 1.5]), np.eye(3), t, 3, 4, 0.1)
    np.testing.assert_allclose(places[0, :2], [0, 0], atol=0.3)
    np.testing.assert_allclose(places[1, :2], [-2, 0], atol=0.3)


def test_bare_patches_and_those_at_the_border_are_not_searched_for(rng):
    noise = rng.uniform(0, 255, (40, 40))
    uv = np.array([[20.0, 20.0], [2.0, 20.0]])
    bare = find_points(
        np.full((40, 40), 7.0), noise, uv, np.ones(2), np.eye(3), np.zeros(3), 3, 4, 2.0
    )
    assert np.isnan(bare).all()
    edge = find_points(noise, noise, uv, np.ones(2), np.eye(3), np.zeros(3), 3, 4, 2.0)
    np.testing.assert_array_equal(np.isnan(edge[:, 2]), [False, True])
