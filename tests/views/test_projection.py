"""Places on a view's grid against the camera's own projection."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera, rotation_from_quat
from splatseed.views.projection import place


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
