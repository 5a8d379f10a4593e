"""Projection: arrays and kernels alike, and against the camera's own formula."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera, rotation_from_quat
from splatseed.photos._kernels import project_block
from splatseed.photos.projection import cells_from_world, grid_shape, pixels_from_world, project


@pytest.fixture
def camera(rng):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_quat(rng.normal(size=4)), rng.normal(size=3)
    return Camera(np.array([[140.0, 0, 80], [0, 150.0, 60], [0, 0, 1]]), 161, 119, pose)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_and_kernels_project_identically(rng, camera, dtype):
    xyz = rng.normal(size=(1000, 3)).astype(dtype)
    xyz[0] = camera.center  # about depth 0, where pixels need not be finite
    matrix, found = pixels_from_world(camera), np.empty((3, len(xyz)))
    project_block(xyz, matrix, found)
    for ours in (project(matrix, xyz), project(matrix, np.asfortranarray(xyz, np.float64))):
        np.testing.assert_array_equal(found, ours)


def test_pixels_and_depths_equal_the_cameras(rng, camera):
    xyz = rng.normal(size=(1000, 3))
    column, row, depth = project(pixels_from_world(camera), xyz)
    uv, z = camera.project(xyz)
    np.testing.assert_allclose(depth, z, atol=1e-12)
    front = z > 1e-3
    np.testing.assert_allclose(np.stack([column, row], axis=1)[front], uv[front], rtol=1e-9)


def test_cells_fill_the_image(rng, camera):
    uv, depth = rng.uniform([0, 0], [161, 119], (50, 2)), rng.uniform(1, 5, 50)
    xyz = camera.unproject(uv, depth)
    assert grid_shape(camera, 8) == (15, 21)
    column, row, _ = project(cells_from_world(camera, 8), xyz)
    np.testing.assert_allclose(column, uv[:, 0] * 21 / 161, atol=1e-9)
    np.testing.assert_allclose(row, uv[:, 1] * 15 / 119, atol=1e-9)
