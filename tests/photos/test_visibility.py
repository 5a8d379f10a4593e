"""Which points a camera sees, against loops over points."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatseed.camera import Camera
from splatseed.photos.visibility import points_in_image
from splatseed.photos.zbuffer import cell_depths, visible_points

CAMERA = Camera(np.array([[60.0, 0, 30], [0, 60.0, 20], [0, 0, 1]]), 61, 41, np.eye(4))


@pytest.mark.parametrize(("near", "margin"), [(0.0, 0.0), (1.5, 0.0), (0.0, 0.1)])
def test_points_in_the_image_equal_those_of_a_plain_loop(rng, near, margin):
    xyz = rng.uniform([-2, -2, -3], [2, 2, 3], (500, 3))
    xyz[7] = np.nan
    xyz[8] = 0.0  # in the camera's centre
    expected = []
    for i, (x, y, z) in enumerate(xyz):
        if z > near:
            u, v = 60 * x / z + 30, 60 * y / z + 20
            if -margin * 61 <= u < 61 * (1 + margin) and -margin * 41 <= v < 41 * (1 + margin):
                expected.append((i, u, v, z))
    found = points_in_image(CAMERA, xyz, near=near, margin=margin)
    assert len(expected) > 20
    np.testing.assert_array_equal(found.point_idx, [each[0] for each in expected])
    np.testing.assert_allclose(found.uv, [each[1:3] for each in expected], atol=1e-12)
    np.testing.assert_array_equal(found.depth, [each[3] for each in expected])


def test_the_z_buffer_has_the_nearest_point_of_each_cell(rng):
    points = points_in_image(CAMERA, rng.uniform([-2, -2, 1], [2, 2, 3], (500, 3)))
    expected = np.full((4, 6), np.inf)
    for (u, v), z in zip(points.uv, points.depth, strict=True):
        i, j = math.floor(v * 4 / 41), math.floor(u * 6 / 61)
        expected[i, j] = min(expected[i, j], z)
    np.testing.assert_array_equal(points.nearest(CAMERA, (4, 6)), expected)


def test_a_wall_occludes_points_behind_it(rng):
    wall = np.column_stack([rng.uniform(-2, 0, 4000), rng.uniform(-2, 2, 4000), np.full(4000, 2.0)])
    behind = np.column_stack([rng.uniform(-1, 1, (50, 2)), np.full(50, 3.0)])
    xyz = np.concatenate([wall, behind]).astype(np.float32)
    assert np.isfinite(cell_depths(CAMERA, xyz, 4)[:, :7]).all()
    visible = np.isin(np.arange(len(xyz)), visible_points(CAMERA, xyz, 4).point_idx)
    points = points_in_image(CAMERA, xyz)
    u, rows = points.uv[:, 0], points.point_idx
    assert visible[rows[(rows < 4000) & (u < 26)]].all()
    assert not visible[rows[(rows >= 4000) & (u < 26)]].any()
    assert visible[rows[(rows >= 4000) & (u > 40)]].all()
    assert not len(visible_points(CAMERA, xyz, 4, np.zeros((41, 61), bool)).point_idx)
