"""Which views are compared, against loops; places on a view's grid; where to look from."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.photos.projection import FULL, LEAST, MOST, WIDE, choose_by_pose, choose_sources
from splatseed.photos.visibility import choose_camera, choose_image
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Scene


def worth(seen, xyz, centers, i: int, j: int) -> float:
    total = 0.0
    for point in set(seen[i].tolist()) & set(seen[j].tolist()):
        rays = [xyz[point] - centers[k] for k in (i, j)]
        cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
        degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        total += np.interp(degrees, [LEAST, FULL, WIDE, MOST], [0, 1, 1, 0])
    return total


def test_views_that_see_the_same_are_paired_as_by_the_loop(rng):
    """Eight cameras about 40 points, each of which sees some of them."""
    xyz, centers = rng.normal(size=(40, 3)), rng.normal(size=(8, 3)) - np.array([0, 0, 5])
    seen = [np.sort(rng.choice(40, rng.integers(5, 30), replace=False)) for _ in centers]
    chosen = choose_sources(seen, xyz, centers, 4)
    assert chosen.shape == (8, 4)
    for i, mine in enumerate(chosen):
        worths = np.array([0.0 if j == i else worth(seen, xyz, centers, i, j) for j in range(8)])
        ours = [worths[j] if j >= 0 else 0.0 for j in mine]
        np.testing.assert_allclose(ours, np.sort(worths)[::-1][:4], atol=1e-9)


def test_nobody_is_paired_without_a_common_point():
    xyz = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    centers = np.array([[0.0, 0, -5], [1.0, 0, -5], [2.0, 0, -5]])
    seen = [np.array([0]), np.array([0, 1]), np.array([1])]
    np.testing.assert_array_equal(choose_sources(seen, xyz, centers, 2), [[1, -1], [0, 2], [1, -1]])
    for num in (0, 1, 3):
        chosen = choose_sources([np.empty(0, int)] * num, xyz[:0], np.zeros((num, 3)), 5)
        np.testing.assert_array_equal(chosen, np.full((num, 5), -1))


LENS = Intrinsics(1, "PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))


def scene_of(xyz, images=()):
    return Scene(PointCloud(xyz, np.full((len(xyz), 3), 90, np.uint8)), images, (LENS,))


def image(number, translation=(0.0, 0.0, 0.0), observations=None):
    quat = np.array([1.0, 0, 0, 0])
    return Image(f"{number}.png", number, LENS, quat, np.array(translation), observations)


def in_frame(camera, xyz):
    uv, _ = camera.project(xyz)
    return ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)


def test_the_image_with_the_fullest_frame_is_chosen(rng):
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


def test_a_bare_cloud_gets_a_camera_that_sees_it_from_above(rng):
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


def test_a_camera_far_away_takes_no_neighbour_from_others():
    """Sources without points: distances once counted relative to the largest of all."""
    poses = np.tile(np.eye(4), (13, 1, 1))
    poses[:12, 0, 3] = 0.1 * np.arange(12)
    poses[12, 0, 3] = 1e7
    chosen = choose_by_pose(poses, 4)
    assert (chosen[:12] >= 0).all()
    np.testing.assert_array_equal(chosen[:12], choose_by_pose(poses[:12], 4))
