"""The image, or the made-up camera, from which a scene is shown."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.photos.viewpoint import choose_camera, choose_image
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.tracks import Observations

LENS = Intrinsics(1, "PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))


def scene_of(xyz, images=()):
    return Scene(PointCloud(xyz, np.full((len(xyz), 3), 90, np.uint8)), images, (LENS,))


def image(number, translation=(0.0, 0.0, 0.0), observations=None):
    quat = np.array([1.0, 0, 0, 0])
    return Image(f"{number}.png", number, LENS, quat, np.array(translation), observations)


def in_frame(camera, xyz):
    uv, _ = camera.project(xyz)
    return ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)


def test_the_image_with_the_largest_fill_is_chosen(rng):
    crowd = Observations(rng.uniform(40, 50, (500, 2)), np.arange(500))
    spread = Observations(rng.uniform([0, 0], [160, 120], (300, 2)), np.arange(300))
    pointless = Observations(rng.uniform([0, 0], [160, 120], (900, 2)), np.full(900, -1))
    images = tuple(image(i + 1, observations=o) for i, o in enumerate((crowd, spread, pointless)))
    scene = scene_of(rng.normal(size=(500, 3)), images)
    assert choose_image(scene) is images[1]
    assert choose_camera(scene) is images[1].camera
    # Without features points are projected, without points it is the image in the middle.
    images = (image(1, (0, 0, -20.0)), image(2), image(3, (50.0, 0, 0)))
    assert (
        choose_image(scene_of(rng.uniform((-1, -1, 3), (1, 1, 5), (400, 3)), images)) is images[1]
    )
    for xyz in (np.empty((0, 3)), np.full((3, 3), np.nan)):
        assert choose_image(scene_of(xyz, images)) is images[1]


def test_a_bare_cloud_is_seen_from_above(rng):
    ground = np.column_stack([rng.uniform(-4, 4, (3000, 2)) * [1.0, 0.6], np.zeros(3000)])
    tree = np.column_stack([rng.normal(0, 0.1, (300, 2)), rng.uniform(0, 1.5, 300)])
    stray = rng.uniform(-300, 300, (60, 3))
    camera = choose_camera(scene_of(np.concatenate([ground, tree, stray])))
    assert in_frame(camera, ground).mean() > 0.5
    assert in_frame(camera, tree).mean() > 0.9
    assert camera.center[2] > 1
    root, top = camera.project(np.array([[0, 0, 0.0], [0, 0, 1.0]]))[0]
    assert top[1] < root[1]


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("num", [1, 2, 5])
def test_tiny_and_flat_clouds_get_a_camera_too(num, offset):
    line = np.linspace(0, 1, num)[:, None] * [0.0, 8.0, 0.0] + offset
    camera = choose_camera(scene_of(line))
    assert np.isfinite(camera.cam_from_world).all()
    assert in_frame(camera, line.astype(np.float32)).any()
