"""The chosen camera must see the cloud, upright, whatever the scene has."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Scene
from splatseed.views.visibility import choose_camera, choose_image, look_at

INTRINSICS = Intrinsics(1, "PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))


def _cloud(xyz):
    return PointCloud(xyz, np.full((len(xyz), 3), 90, np.uint8))


def _image(number, translation=(0.0, 0.0, 0.0), observations=None):
    quat = np.array([1.0, 0, 0, 0])
    return Image(f"{number}.png", number, INTRINSICS, quat, np.array(translation), observations)


def _in_frame(camera, xyz):
    uv, _ = camera.project(xyz)
    return ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)


def test_look_at_centres_the_target_with_up_upward():
    eye, target = np.array([3.0, -2, 1]), np.array([0.2, 0.1, 0.4])
    cam_from_world = look_at(eye, target, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(
        cam_from_world[:3, :3] @ cam_from_world[:3, :3].T, np.eye(3), atol=1e-12
    )
    assert np.linalg.det(cam_from_world[:3, :3]) == pytest.approx(1)
    seen = cam_from_world @ [*target, 1]
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(eye - target), 1], atol=1e-12)
    assert (cam_from_world[:3, :3] @ [0, 0, 1.0])[1] < 0  # y points down in the image


def test_the_image_with_the_fullest_frame_is_chosen_over_the_one_with_most_features(rng):
    crowd = Observations(rng.uniform(40, 50, (500, 2)), np.arange(500))
    spread = Observations(rng.uniform([0, 0], [160, 120], (300, 2)), np.arange(300))
    pointless = Observations(rng.uniform([0, 0], [160, 120], (900, 2)), np.full(900, -1))
    images = tuple(_image(i + 1, observations=o) for i, o in enumerate((crowd, spread, pointless)))
    scene = Scene(_cloud(rng.normal(size=(500, 3))), images, (INTRINSICS,))
    assert choose_image(scene) is images[1]
    assert choose_camera(scene) is images[1].camera


def test_without_features_the_points_are_projected(rng):
    xyz = rng.uniform(-1, 1, (400, 3)) + np.array([0, 0, 4])
    images = (_image(1, (0, 0, -20.0)), _image(2, (0, 0, 0.0)), _image(3, (50.0, 0, 0)))
    assert choose_image(Scene(_cloud(xyz), images, (INTRINSICS,))) is images[1]


def test_a_bare_cloud_gets_a_camera_that_sees_it_from_above(rng):
    ground = np.column_stack([rng.uniform(-4, 4, (3000, 2)) * [1.0, 0.6], np.zeros(3000)])
    tree = np.column_stack([rng.normal(0, 0.1, (300, 2)), rng.uniform(0, 1.5, 300)])
    stray = rng.uniform(-300, 300, (60, 3))
    cloud = _cloud(np.concatenate([ground, tree, stray]))
    camera = choose_camera(Scene(cloud))
    assert _in_frame(camera, ground).mean() > 0.5
    assert _in_frame(camera, tree).mean() > 0.9
    assert camera.center[2] > 1
    root, top = camera.project(np.array([[0, 0, 0.0], [0, 0, 1.0]]))[0]
    assert top[1] < root[1]


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("num", [1, 2, 5])
def test_tiny_and_flat_clouds_get_a_camera_too(num, offset):
    line = np.linspace(0, 1, num)[:, None] * [0.0, 8.0, 0.0] + offset
    camera = choose_camera(Scene(_cloud(line)))
    assert np.isfinite(camera.cam_from_world).all()
    assert _in_frame(camera, line.astype(np.float32)).any()


def test_photographs_without_points_are_looked_at_from_the_middle():
    """Such as an RGB-D capture, whose seeds are all new."""
    for xyz in (np.empty((0, 3)), np.full((3, 3), np.nan)):
        scene = Scene(_cloud(xyz), tuple(_image(i) for i in (1, 2, 3)), (INTRINSICS,))
        assert choose_image(scene).name == "2.png"
        assert choose_camera(scene).width == INTRINSICS.width
