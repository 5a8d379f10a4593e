"""Poses without points: refused or measured at once, never the sound ones; where trainers begin."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.seeding import poses as module
from splatseed.seeding.poses import TURNS, check_poses, low_agreement, pose_error, random_start
from splatseed.seeding.upsampling import upsample

YZ, XY = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
PLAIN_YZ, PLAIN_XY, INVERTED, INVERTED_YZ = TURNS


def _posed(scene, poses):
    """The scene without points, at other poses."""
    images = tuple(
        replace(im, quat=quat_from_rotation(p[:3, :3]), translation=p[:3, 3], observations=None)
        for im, p in zip(scene.images, poses, strict=False)
    )
    return scene.replace(points=PointCloud.empty(), tracks=None, images=images)


@pytest.fixture
def poses(room):
    return np.array([image.camera.cam_from_world for image in room.images])


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_sound_poses_pass_in_any_unit_at_the_first_look(unit, room, poses, monkeypatch):
    looks = []
    plain = module._look
    monkeypatch.setattr(module, "_look", lambda *a: looks.append(plain(*a)) or looks[-1])
    poses[:, :3, 3] *= unit
    scene = _posed(room, poses)
    check_poses(scene, scene.images)
    assert len(looks) == 1
    error = pose_error(scene, scene.images)
    assert error.exact
    assert error.px < 0.5
    assert not error.warning


def _back_to_back():
    """Four cameras whose axes begin 5 units from the middle."""
    outward = np.tile(np.eye(4), (4, 1, 1))
    turns = Rotation.from_euler("y", np.arange(4)[:, None] * 90, degrees=True)
    outward[:, :3, :3], outward[:, 2, 3] = turns.as_matrix(), -5.0
    return outward


def _in_place(poses, place):
    centers = np.broadcast_to(np.asarray(place), (len(poses), 3))
    poses[:, :3, 3] = -np.einsum("vij,vj->vi", poses[:, :3, :3], centers)
    return poses


@pytest.mark.parametrize(
    ("spoil", "error", "says"),
    [
        (lambda poses: YZ @ poses, SceneFormatError, f"once {PLAIN_YZ}.*with OpenCV's"),
        (lambda poses: XY @ poses, SceneFormatError, f"once {PLAIN_XY}"),
        (np.linalg.inv, SceneFormatError, f"once {INVERTED}"),
        (lambda poses: np.linalg.inv(poses) @ YZ, SceneFormatError, f"once {INVERTED_YZ}"),
        (np.random.default_rng(0).permutation, SceneFormatError, "agree.*names of the images"),
        (lambda poses: _in_place(poses, (0.0, 0, 0)), SceneFormatError, "all 16 cameras in one"),
        (lambda poses: _in_place(poses, (100.0, -20, 3)), SceneFormatError, "all 16 cameras in"),
        (lambda _: _back_to_back(), SceneFormatError, "no two of 4 whose pictures overlap"),
        (lambda poses: poses[:1], SceneNotFoundError, "at least two photographs.*found 1"),
    ],
)
def test_poses_at_which_nothing_can_be_compared_are_refused(spoil, error, says, room, poses):
    scene = _posed(room, spoil(poses))
    with pytest.raises(error, match=says):
        check_poses(scene, scene.images)


def test_only_scenes_without_points_are_checked_and_say_what_was_found(room, poses, monkeypatch):
    notes = []
    seeds = upsample(_posed(room, poses), note=notes.append)
    assert len(seeds) > 300
    (said,) = notes
    assert said.startswith("There were no points to begin from: comparing the photographs gave ")
    monkeypatch.setattr(module, "check_poses", None)
    upsample(room, "stereo", note=notes.append)
    assert len(notes) == 1
    with pytest.raises(SceneNotFoundError, match=r"beside those held out.*all 1 are held out"):
        upsample(_posed(room, poses[:1]), test_every=8)


def test_noise_is_measured(room, poses):
    rng, found = np.random.default_rng(0), []
    axes = rng.normal(size=(len(poses), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for degrees in (1.0, 4.0):
        turns = np.tile(np.eye(4), (len(poses), 1, 1))
        turns[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix()
        scene = _posed(room, turns @ poses)
        found.append(pose_error(scene, scene.images))
    assert found[0].px < found[1].px
    assert found[0].degrees < found[1].degrees
    # Two turns by an angle about random axes differ by 1.3 of it; half of that lies along lines.
    focal = room.images[0].camera.K[0, 0]
    for error, degrees in zip(found, (1.0, 4.0), strict=True):
        assert 0.3 * degrees < error.degrees < 1.3 * degrees
        assert error.px == pytest.approx(focal * np.tan(np.radians(error.degrees)), rel=0.1)
    assert "--refine-poses may fix that" in found[-1].warning


@pytest.mark.parametrize(("trainer", "num"), [("gsplat", 100_000), ("nerfstudio", 50_000)])
def test_points_fill_a_cube_around_the_cameras(room, trainer, num):
    points = random_start(room, np.random.default_rng(0), trainer)
    assert len(points) == num
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    np.testing.assert_allclose(high - low, (high - low)[0], rtol=1e-3)
    centers = np.stack([image.camera.center for image in room.images])
    assert ((centers > low) & (centers < high)).all()
    again = random_start(room, np.random.default_rng(0), trainer)
    assert again.xyz.tobytes() == points.xyz.tobytes()


def _changed(scene, folder, change, mask=None):
    """The scene without points, its photographs changed, and with one mask for all."""
    path = shutil.copytree(scene.source.root, folder)
    rng = np.random.default_rng(1)
    for file in sorted((path / "images").iterdir()):
        pixels = change(np.asarray(PilImage.open(file), np.float64), rng)
        PilImage.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(file)
        if mask is not None:
            (path / "masks").mkdir(exist_ok=True)
            PilImage.fromarray(mask).save(path / "masks" / f"{file.name}.png")
    return load_scene(path).replace(points=PointCloud.empty(), tracks=None)


def test_only_pixels_that_count_have_to_agree(room, tmp_path):
    mask = np.zeros((120, 160), np.uint8)
    mask[40:100, 50:130] = 255  # a quarter
    scene = _changed(room, tmp_path / "statue", lambda pixels, _: pixels, mask)
    share = check_poses(scene, scene.images)
    assert share > 0.3
    assert low_agreement(share, 0.75) == ""


def test_light_that_changes_is_told_and_exposure_is_not(room, tmp_path):
    exposed = _changed(room, tmp_path / "exposed", lambda p, rng: p * rng.uniform(0.4, 1.2))
    assert low_agreement(check_poses(exposed, exposed.images)) == ""

    def light(pixels, rng):
        return pixels * np.exp(2.0 * zoom(rng.normal(size=(9, 12)), 120 / 9, order=1))[..., None]

    lit = _changed(room, tmp_path / "lit", light)
    told = low_agreement(check_poses(lit, lit.images))
    assert "agree on the depth of only" in told
    assert "reasons are light that changes between photographs" in told
    assert "masks that leave 20% of the pixels" in low_agreement(0.08, 0.8)


def test_an_error_is_in_pixels_of_the_size_that_is_compared(room, poses, monkeypatch):
    """A larger photograph is compared smaller; what is told is the number that is judged."""
    turns = np.tile(np.eye(4), (len(poses), 1, 1))
    angles = np.radians(0.6) * np.random.default_rng(0).normal(size=(len(poses), 3))
    turns[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    scene = _posed(room, turns @ poses)
    whole = pose_error(scene, scene.images)
    monkeypatch.setattr(module.StereoSettings, "max_size", 80)
    half = pose_error(scene, scene.images)
    assert (whole.side, half.side) == (160, 80)
    assert half.px == pytest.approx(whole.px / 2)
    assert half.degrees == whole.degrees
    for error in (whole, half):
        assert error.exact == (round(error.px, 2) <= 0.5) == (error.warning == "")
        assert f"{error.px:.2g} px" in str(error)
        assert f"at {error.side} px a side" in str(error)
