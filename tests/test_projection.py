"""Projection: arrays and kernels alike, and against the definition."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera, rotation_from_quat
from splatseed.photos._kernels import project_block
from splatseed.projection import camera_centers, normalized, pixel_centers, project


@pytest.fixture
def camera(rng):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_quat(rng.normal(size=4)), rng.normal(size=3)
    return Camera(np.array([[140.0, 3, 80], [0, 150.0, 60], [0, 0, 1]]), 161, 119, pose)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_and_kernels_project_identically(rng, camera, dtype):
    xyz = rng.normal(size=(1000, 3)).astype(dtype)
    xyz[0] = camera.center  # about depth 0, where pixels need not be finite
    matrix, found = camera.pixels_from_world, np.empty((3, len(xyz)))
    project_block(xyz, matrix, found)
    for ours in (project(matrix, xyz), project(matrix, np.asfortranarray(xyz, np.float64))):
        np.testing.assert_array_equal(found, ours)
    uv, depth = camera.project(xyz)
    np.testing.assert_array_equal(depth, found[2])
    np.testing.assert_array_equal(uv, np.where(depth > 0, found[:2], np.nan).T)


def test_pixels_and_depths_are_those_of_the_definition(rng, camera):
    xyz = rng.normal(size=(1000, 3))
    in_camera = (camera.cam_from_world @ np.column_stack([xyz, np.ones(1000)]).T)[:3]
    u, v, z = camera.K @ in_camera
    column, row, depth = project(camera.pixels_from_world, xyz)
    np.testing.assert_allclose(depth, z, atol=1e-12)
    np.testing.assert_allclose([column * depth, row * depth], [u, v], atol=1e-9)


def test_rays_lead_back_to_their_pixels(rng, camera):
    uv = pixel_centers(camera.height, camera.width)
    assert uv.shape == (119, 161, 2)
    assert uv[2, 5].tolist() == [5.5, 2.5]
    x, y = np.moveaxis(normalized(camera.K, uv), -1, 0)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    np.testing.assert_allclose((rays @ camera.K.T)[..., :2], uv, rtol=1e-12)
    # One unit along the axis, in the world's directions.
    np.testing.assert_allclose(rays @ camera.cam_from_world[:3, :3], camera.rays(uv), atol=1e-12)
    back, depth = camera.project(camera.center + 3 * camera.rays(uv).reshape(-1, 3))
    np.testing.assert_allclose(back, uv.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(depth, 3, rtol=1e-12)


def test_cameras_stand_where_their_poses_map_to_0(camera):
    centers = camera_centers([camera.cam_from_world, np.eye(4)])
    np.testing.assert_array_equal(centers, [camera.center, np.zeros(3)])
    in_camera = camera.cam_from_world @ [*camera.center, 1]
    np.testing.assert_allclose(in_camera, [0, 0, 0, 1], atol=1e-12)
    assert camera_centers([]).shape == (0, 3)


def test_cells_fill_the_image(rng, camera):
    uv, depth = rng.uniform([0, 0], [161, 119], (50, 2)), rng.uniform(1, 5, 50)
    xyz = camera.unproject(uv, depth)
    assert camera.grid_shape(8) == (15, 21)
    column, row, _ = project(camera.cells_from_world(8), xyz)
    np.testing.assert_allclose(column, uv[:, 0] * 21 / 161, atol=1e-9)
    np.testing.assert_allclose(row, uv[:, 1] * 15 / 119, atol=1e-9)
