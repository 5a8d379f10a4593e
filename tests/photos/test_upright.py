"""Cameras of photographs that are stored sideways are turned, others are kept."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.photos.upright import quarter_turns, turned, up_direction, vertical
from splatseed.photos.viewpoint import look_at
from splatseed.scene import Image

UP = np.array([0.0, 0.0, 1.0])
ORIENTATION = 0x0112


def ring(quarters, height=0.0, wide=2 * np.pi):
    """Cameras in an arc around the origin, with images that must be turned clockwise."""
    lens = Intrinsics(1, "PINHOLE", 120, 90, (100.0, 105.0, 58.0, 46.0))
    if quarters % 2:
        lens = Intrinsics(1, "PINHOLE", 90, 120, (105.0, 100.0, 46.0, 62.0))
    images = []
    for i, angle in enumerate(np.linspace(0, wide, 12, endpoint=False)):
        eye = np.array([3 * np.cos(angle), 3 * np.sin(angle), height])
        pose = look_at(eye, np.zeros(3), UP)
        quarter = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        pose[:3] = np.linalg.matrix_power(quarter, quarters) @ pose[:3]
        images.append(
            Image(f"{i:03}.jpg", i + 1, lens, quat_from_rotation(pose[:3, :3]), pose[:3, 3])
        )
    return images


@pytest.mark.parametrize(
    ("quarters", "height", "wide"),
    [(0, 0, 6.3), (0, 2, 6.3), (0, 6, 6.3), (0, 2, 1.5), (0, 0, 0.2), (1, 0, 6.3), (1, 2, 6.3),
     (1, 1, 1.5), (1, -0.2, 6.3), (3, 2, 6.3)],
)  # fmt: skip
def test_sideways_cameras_are_turned_by_their_poses(quarters, height, wide):
    images = ring(quarters, height, wide)
    assert quarter_turns(images) == [quarters] * 12
    cameras = [turned(image.camera, quarters) for image in images]
    np.testing.assert_allclose(up_direction(cameras) @ UP, 1, atol=0.5)
    assert (cameras[0] is images[0].camera) == (quarters == 0)


@pytest.mark.parametrize(("height", "wide"), [(2, 1.0), (6, 6.3), (1, 2.0)])
def test_up_is_vertical_though_all_cameras_look_down(height, wide):
    """From 18 to 63 degrees above: the mean of their up axes leans as far if they are on one
    side."""
    cameras = [image.camera for image in ring(0, height, wide)]
    assert up_direction(cameras) @ UP > np.cos(np.radians(4))


def test_gravity_of_a_phone_is_known(room):
    cameras = [image.camera for image in ring(0, 2, 1.0)]
    assert vertical(room, cameras) @ UP > 0.99
    phone = room.replace(source=dataclasses.replace(room.source, format="phone"))
    np.testing.assert_array_equal(vertical(phone, cameras), [0, 1, 0])


def test_a_turned_camera_sees_the_same(rng):
    camera = ring(0)[2].camera
    xyz = rng.uniform(-1, 1, (9, 3))
    (u, v), depth = camera.project(xyz)[0].T, camera.project(xyz)[1]
    for quarters, expected in ((1, (90 - v, u)), (2, (120 - u, 90 - v)), (3, (v, 120 - u))):
        uv, same = turned(camera, quarters).project(xyz)
        np.testing.assert_allclose(uv, np.transpose(expected))
        np.testing.assert_allclose(same, depth)
    assert (turned(camera, 1).width, turned(camera, 1).height) == (90, 120)


def test_exif_decides_before_poses(tmp_path):
    """In a fan of cameras poses show nothing, and half of the photographs are held upright."""
    images = [dataclasses.replace(each, folder=tmp_path) for each in ring(0, wide=0.2)]
    for i, image in enumerate(images):
        exif = PilImage.Exif()
        exif[ORIENTATION] = (6, 1, 8, 3)[i % 4]
        PilImage.new("RGB", (12, 9)).save(image.path, exif=exif)
    assert quarter_turns(images) == [1, 0, 3, 2] * 3
    recorded = {image.name: (6, 1, 8, 3)[i % 4] for i, image in enumerate(images)}
    copies = tmp_path / "scene" / "images"
    copies.mkdir(parents=True)
    for image in images:  # as sfm copies them: EXIF says upright, the manifest what it said
        PilImage.new("RGB", (12, 9)).save(copies / image.name)
    (tmp_path / "linked").symlink_to(copies)  # as in an output of upsample
    (tmp_path / "scene" / "splatseed.json").write_text(json.dumps({"orientations": recorded}))
    copied = [dataclasses.replace(image, folder=tmp_path / "linked") for image in images]
    assert quarter_turns(copied) == [1, 0, 3, 2] * 3
    tall = dataclasses.replace(images[0].intrinsics, width=90, height=120)
    images = [dataclasses.replace(image, intrinsics=tall) for image in images]
    assert quarter_turns(images) == [0] * 12  # a tag that was kept beside turned pixels
    assert quarter_turns([]) == []


def test_without_a_common_up_it_is_minus_y():
    up, down = ring(0)[0].camera, turned(ring(0)[0].camera, 2)
    np.testing.assert_allclose(up_direction([up]), UP, atol=1e-12)
    np.testing.assert_allclose(up_direction([up, down]), [0, -1, 0])
    np.testing.assert_allclose(up_direction([]), [0, -1, 0])
