"""Poses without points: refused or measured at once, never the sound ones; where trainers begin."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.pointcloud import PointCloud
from splatseed.seeding import poses as module
from splatseed.seeding.poses import TURNS, check_poses, random_start
from splatseed.seeding.upsampling import upsample
from splatseed.synthetic import make_capture

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
    plain = module._look
    monkeypatch.setattr(module, "_look", lambda *a: looks.append(plain(*a)) or looks[-1])
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
    monkeypatch.setattr(module, "check_poses", None)
    upsample(room, "stereo", note=notes.append)
    assert len(notes) == 1


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
    return module.pose_error(scene, scene.images)


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


def test_masked_corners_do_not_count(room, monkeypatch):
    plain, seen = module.load_views, []

    def masked(*arguments, **options):
        views = plain(*arguments, **options)
        seen.extend(views)
        return [replace(v, mask=np.zeros((v.height, v.width), np.bool_)) for v in views]

    monkeypatch.setattr(module, "load_views", masked)
    assert _measured(_turned(room, 0.0)) is None
    assert seen


@pytest.fixture(scope="module")
def scene():
    return make_capture(0, num_views=6, width=32, height=32).scene


@pytest.mark.parametrize(("trainer", "num"), [("gsplat", 100_000), ("nerfstudio", 50_000)])
def test_points_fill_a_cube_around_the_cameras(scene, trainer, num):
    points = random_start(scene, np.random.default_rng(0), trainer)
    assert len(points) == num
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    np.testing.assert_allclose(high - low, (high - low)[0], rtol=1e-3)
    centers = np.stack([image.camera.center for image in scene.images])
    assert (centers > low).all()
    assert (centers < high).all()
    again = random_start(scene, np.random.default_rng(0), trainer)
    assert again.xyz.tobytes() == points.xyz.tobytes()
