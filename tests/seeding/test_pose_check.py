"""Poses at which photographs cannot be compared are refused at once, and sound ones never."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatseed.camera import quat_from_rotation
from splatseed.errors import PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.pointcloud import PointCloud
from splatseed.seeding.poses_alone import pose_check
from splatseed.seeding.poses_alone.pose_check import TURNS, check_poses
from splatseed.seeding.upsampling import upsample

YZ, XY = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
PLAIN_YZ, PLAIN_XY, INVERTED, INVERTED_YZ = TURNS


def _posed(scene, poses):
    """The scene without points, at other poses."""
    images = tuple(
        replace(im, quat=quat_from_rotation(p[:3, :3]), translation=p[:3, 3], observations=None)
        for im, p in zip(scene.images, poses, strict=False)
    )
    none = PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))
    return replace(scene, points=none, tracks=None, images=images)


@pytest.fixture
def poses(room):
    return np.array([image.camera.cam_from_world for image in room.images])


def _check(scene):
    check_poses(scene, scene.images)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_sound_poses_pass_in_any_unit_at_the_first_look(unit, room, poses, monkeypatch):
    looks = []
    plain = pose_check._look
    monkeypatch.setattr(pose_check, "_look", lambda *a: looks.append(plain(*a)) or looks[-1])
    poses[:, :3, 3] *= unit
    _check(_posed(room, poses))
    assert len(looks) == 1


@pytest.mark.parametrize(
    ("spoil", "undone"),
    [
        (lambda poses: YZ @ poses, PLAIN_YZ),
        (lambda poses: XY @ poses, PLAIN_XY),
        (np.linalg.inv, INVERTED),
        (lambda poses: YZ @ np.linalg.inv(poses), INVERTED),  # differs by a turn of the world
        (lambda poses: np.linalg.inv(poses) @ YZ, INVERTED_YZ),
    ],
)
def test_the_turn_that_makes_photographs_agree_is_named(spoil, undone, room, poses):
    with pytest.raises(SceneFormatError) as caught:
        _check(_posed(room, spoil(poses)))
    assert caught.value.found.endswith(f"once {undone}")
    assert "cam_from_world, with OpenCV's" in caught.value.fix  # as COLMAP writes them


def test_poses_of_other_photographs_agree_nowhere(room, poses):
    exchanged = _posed(room, np.random.default_rng(0).permutation(poses))
    with pytest.raises(SceneFormatError, match=r"agree at the poses.*names of the images"):
        _check(exchanged)


def test_pictures_that_cannot_overlap(room):
    """Four cameras back to back."""
    outward = np.tile(np.eye(4), (4, 1, 1))
    for pose, angle in zip(outward, np.arange(4) * np.pi / 2, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        pose[2, 3] = -5.0  # the camera's axis begins 5 units from the middle
    with pytest.raises(SceneFormatError, match="no two of 4 whose pictures overlap"):
        _check(_posed(room, outward))


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [100.0, -20.0, 3.0]])
def test_cameras_that_only_turn(place, room, poses):
    poses[:, :3, 3] = -poses[:, :3, :3] @ place
    with pytest.raises(SceneFormatError, match="all 16 cameras in one place, as in a panorama"):
        _check(_posed(room, poses))


def test_one_photograph(room, poses):
    with pytest.raises(SceneNotFoundError, match=r"at least two photographs.*found 1"):
        _check(_posed(room, poses[:1]))
    with pytest.raises(SceneNotFoundError, match=r"beside those held out.*all 1 are held out"):
        upsample(_posed(room, poses[:1]), hold_out=8)


def test_only_scenes_without_points_are_checked_and_say_what_was_found(room, poses, monkeypatch):
    notes = []
    seeds = upsample(_posed(room, poses), note=notes.append)
    assert len(seeds) > 300
    (said,) = notes
    assert said.startswith("There were no points to begin from: comparing the photographs gave ")
    monkeypatch.setattr(pose_check, "check_poses", None)
    upsample(room, "stereo", note=notes.append)
    assert len(notes) == 1


def test_too_few_points_vouch_for_the_poses_but_are_not_begun_from(room, monkeypatch):
    monkeypatch.setattr(pose_check, "check_poses", None)
    notes, every = [], len(room.points) // 100
    few = room.replace(points=room.points.select(np.arange(len(room.points)) % every == 0))
    upsample(few, "stereo", note=notes.append)
    assert [note.split(":")[0] for note in notes] == ["There were too few points to begin from"]


def test_cover_needs_points(room, poses):
    with pytest.raises(
        PointCloudError, match=r"points for the method cover.*found none.*--method auto"
    ):
        upsample(_posed(room, poses), "cover")
