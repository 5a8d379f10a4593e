"""By how much photographs miss each other is measured at noisy poses, and nil at sound ones."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.errors import SceneFormatError
from splatseed.pointcloud import PointCloud
from splatseed.seeding.poses_alone import pose_check, pose_error
from splatseed.seeding.poses_alone.pose_check import check_poses
from splatseed.seeding.upsampling import upsample


def _turned(scene, degrees, unit=1.0, seed=0):
    """The scene without points, in another unit, each camera turned by so much about some axis."""
    rng = np.random.default_rng(seed)
    images = []
    for image in scene.images:
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        pose = image.camera.cam_from_world
        R, t = turn @ pose[:3, :3], turn @ pose[:3, 3] * unit
        quat = quat_from_rotation(R)
        images.append(replace(image, quat=quat, translation=t, observations=None))
    return scene.replace(points=PointCloud.empty(), tracks=None, images=tuple(images))


def _measured(scene):
    return pose_error.pose_error(scene, scene.images)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_sound_poses_are_exact_in_any_unit(unit, room):
    error = _measured(_turned(room, 0.0, unit))
    assert error.exact
    assert error.px < 0.5
    assert not error.warning


def test_noise_is_measured(room):
    found = [_measured(_turned(room, degrees)) for degrees in (0.0, 1.0, 2.0, 4.0)]
    assert all(a.px < b.px and a.degrees < b.degrees for a, b in pairwise(found))
    # Two turns by an angle about random axes differ by 1.3 of it; half of that lies along lines.
    for error, degrees in zip(found[1:], (1.0, 2.0, 4.0), strict=True):
        assert 0.3 * degrees < error.degrees < 1.3 * degrees
        camera = room.images[0].camera
        assert error.px == pytest.approx(
            camera.K[0, 0] * np.tan(np.radians(error.degrees)), rel=0.1
        )
    assert "--refine-poses may mend that" in found[-1].warning


def test_poses_of_other_photographs_cannot_be_measured(room):
    order = np.random.default_rng(3).permutation(len(room.images))
    exchanged = [
        replace(image, quat=room.images[k].quat, translation=room.images[k].translation)
        for image, k in zip(room.images, order, strict=True)
    ]
    error = _measured(room.replace(images=tuple(exchanged)))
    assert error is None or error.px > 5


def test_plain_photographs_tell_nothing(room, monkeypatch):
    plain = pose_error.load_views

    def gray(*arguments, **options):
        return [
            replace(v, photograph=np.full_like(v.photograph, 90))
            for v in plain(*arguments, **options)
        ]

    monkeypatch.setattr(pose_error, "load_views", gray)
    assert _measured(_turned(room, 0.0)) is None


def test_masked_corners_do_not_count(room, monkeypatch):
    plain, seen = pose_error.load_views, []

    def masked(*arguments, **options):
        views = plain(*arguments, **options)
        seen.extend(views)
        return [replace(v, mask=np.zeros((v.height, v.width), np.bool_)) for v in views]

    monkeypatch.setattr(pose_error, "load_views", masked)
    assert _measured(_turned(room, 0.0)) is None
    assert seen


def test_seeds_at_inexact_poses_come_with_a_warning(room, monkeypatch):
    monkeypatch.setattr(pose_check, "TURNS", {"nothing": lambda poses: poses})
    notes = []
    upsample(_turned(room, 1.0), "stereo", note=notes.append)
    assert any(note.startswith("The photographs miss each other by about") for note in notes)


def test_photographs_that_agree_nowhere_are_told_how_far_they_miss(room, monkeypatch):
    monkeypatch.setattr(pose_check, "_look", lambda *_: 0.0)
    scene = _turned(room, 2.0)
    with pytest.raises(
        SceneFormatError, match=r"they miss each other by about .* px.*--refine-poses"
    ):
        check_poses(scene, scene.images)
    with pytest.raises(SceneFormatError, match="Check that poses and names of the images belong"):
        check_poses(_turned(room, 0.0), _turned(room, 0.0).images)
