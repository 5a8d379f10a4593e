"""Which views are compared with each other, against a loop over points and views."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from splatseed.views.pairs import FULL, LEAST, MOST, WIDE, choose_sources


def weight(degrees: float) -> float:
    """None at LEAST, full from FULL to WIDE, none at MOST; straight between."""
    return float(np.interp(degrees, [LEAST, FULL, WIDE, MOST], [0, 1, 1, 0]))


def worth(seen, xyz, centers, i: int, j: int) -> float:
    total = 0.0
    for point in set(seen[i].tolist()) & set(seen[j].tolist()):
        rays = [xyz[point] - centers[k] for k in (i, j)]
        cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
        total += weight(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return total


@pytest.fixture
def capture(rng):
    """Eight cameras about 40 points, each of which sees some of them."""
    xyz = rng.normal(size=(40, 3))
    centers = rng.normal(size=(8, 3)) - np.array([0, 0, 5])
    seen = [np.sort(rng.choice(40, rng.integers(5, 30), replace=False)) for _ in centers]
    return seen, xyz, centers


def test_it_is_the_loop(capture):
    seen, xyz, centers = capture
    chosen = choose_sources(seen, xyz, centers, 4)
    assert chosen.shape == (8, 4)
    for i, mine in enumerate(chosen):
        worths = np.array([0.0 if j == i else worth(seen, xyz, centers, i, j) for j in range(8)])
        best = np.sort(worths)[::-1][:4]
        ours = [worths[j] if j >= 0 else 0.0 for j in mine]
        np.testing.assert_allclose(ours, best, atol=1e-9)


def test_nobody_is_paired_without_a_common_point():
    xyz = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    centers = np.array([[0.0, 0, -5], [1.0, 0, -5], [2.0, 0, -5]])
    seen = [np.array([0]), np.array([0, 1]), np.array([1])]
    np.testing.assert_array_equal(choose_sources(seen, xyz, centers, 2), [[1, -1], [0, 2], [1, -1]])


def test_a_view_from_the_same_place_tells_nothing():
    xyz = np.tile([0.0, 0, 4], (3, 1))
    centers = np.array([[0.0, 0, 0], [0.0, 0, 0], [0.7, 0, 0]])
    every = [np.arange(3)] * 3
    np.testing.assert_array_equal(
        choose_sources(every, xyz, centers, 2), [[2, -1], [2, -1], [0, 1]]
    )


@pytest.mark.parametrize("num_views", [0, 1, 3])
def test_without_points_there_are_no_pairs(num_views):
    none = [np.empty(0, np.int64)] * num_views
    chosen = choose_sources(none, np.empty((0, 3)), np.zeros((num_views, 3)), 5)
    np.testing.assert_array_equal(chosen, np.full((num_views, 5), -1))


def test_a_point_at_a_camera_spoils_nothing(capture):
    seen, xyz, centers = capture
    before = choose_sources(seen, xyz, centers, 4)
    alone = np.array(len(xyz))
    odd = [np.append(mine, alone) if i == 2 else mine for i, mine in enumerate(seen)]
    after = choose_sources(odd, np.vstack([xyz, centers[2]]), centers, 4)
    np.testing.assert_array_equal(before, after)
    shared = [np.append(mine, alone) for mine in seen]
    assert (choose_sources(shared, np.vstack([xyz, centers[2]]), centers, 4) < 8).all()


def test_any_number_of_threads(capture):
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = choose_sources(*capture, 5)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(alone, choose_sources(*capture, 5))
