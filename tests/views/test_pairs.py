"""Which views are compared with each other, against loops; places on a view's grid."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera, rotation_from_quat
from splatseed.views.pairs import FULL, LEAST, MOST, WIDE, choose_sources
from splatseed.views.projection import place


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


@pytest.mark.parametrize("num_views", [0, 1, 3])
def test_without_points_there_are_no_pairs(num_views):
    none = [np.empty(0, np.int64)] * num_views
    chosen = choose_sources(none, np.empty((0, 3)), np.zeros((num_views, 3)), 5)
    np.testing.assert_array_equal(chosen, np.full((num_views, 5), -1))


@pytest.fixture
def camera(rng):
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation_from_quat(rng.normal(size=4))
    cam_from_world[:3, 3] = rng.normal(size=3)
    return Camera(np.array([[50.0, 0, 20], [0, 60.0, 15], [0, 0, 1]]), 40, 30, cam_from_world)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_places_are_those_of_the_camera(camera, rng, dtype):
    xyz = rng.normal(size=(50, 3)).astype(dtype)
    placed = np.array([place(point, camera.K @ camera.cam_from_world[:3]) for point in xyz])
    uv, depth = camera.project(xyz)
    assert np.allclose(placed[:, 2], depth, rtol=1e-12, atol=1e-14)
    assert 10 < (depth > 0).sum() < 50
    assert np.allclose(placed[depth > 0, :2], uv[depth > 0], rtol=1e-9)


def test_a_point_in_the_plane_of_the_camera_is_nowhere():
    column, row, depth = place(np.array([1.0, 0.0, 0.0]), np.eye(3, 4))
    assert depth == 0
    assert not np.isfinite([column, row]).any()
