"""The error of poses, measured by epipolar lines, against noise of known size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.checkup import pose_accuracy as module
from splatseed.checkup.focal_by_pairs import find_focal_length
from splatseed.checkup.pose_accuracy import estimate_pose_error
from splatseed.checkup.poses import check_poses
from splatseed.pointcloud import PointCloud


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
def test_sound_poses_are_exact_in_any_unit(unit, room, poses):
    poses[:, :3, 3] *= unit
    scene = _posed(room, poses)
    error = estimate_pose_error(scene, scene.images)
    assert error.exact
    assert error.px < 0.5
    assert not error.findings


def test_noise_is_measured(room, poses):
    rng, found = np.random.default_rng(0), []
    axes = rng.normal(size=(len(poses), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for degrees in (1.0, 4.0):
        rotations = np.tile(np.eye(4), (len(poses), 1, 1))
        rotations[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * axes).as_matrix()
        scene = _posed(room, rotations @ poses)
        found.append(estimate_pose_error(scene, scene.images))
    assert found[0].px < found[1].px
    assert found[0].degrees < found[1].degrees
    # Two rotations by an angle about random axes differ by 1.3 of it; half lies along the lines.
    focal = room.images[0].camera.K[0, 0]
    for error, degrees in zip(found, (1.0, 4.0), strict=True):
        assert 0.3 * degrees < error.degrees < 1.3 * degrees
        assert error.px == pytest.approx(focal * np.tan(np.radians(error.degrees)), rel=0.1)
    assert [each.kind for each in found[-1].findings] == [module.INEXACT_POSES]


def test_the_error_is_in_pixels_of_the_size_of_stereo(room, poses, monkeypatch):
    """A larger photograph is reduced first; the printed number is the one that decides."""
    rotations = np.tile(np.eye(4), (len(poses), 1, 1))
    angles = np.radians(0.6) * np.random.default_rng(0).normal(size=(len(poses), 3))
    rotations[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    scene = _posed(room, rotations @ poses)
    full = estimate_pose_error(scene, scene.images)
    monkeypatch.setattr(module.StereoSettings, "max_size", 80)
    half = estimate_pose_error(scene, scene.images)
    assert (full.side, half.side) == (160, 80)
    assert half.px == pytest.approx(full.px / 2)
    assert half.degrees == full.degrees
    for error in (full, half):
        assert error.exact == (round(error.px, 2) <= 0.5) == (not error.findings)
        assert f"{error.px:.2g} px" in str(error)
        assert f"at {error.side} px a side" in str(error)


@pytest.mark.parametrize("factor", [2, 4])
def test_photographs_smaller_than_their_cameras_are_measured_at_their_size(room, poses, factor):
    scene = _posed(room, poses)
    lens = scene.images[0].intrinsics
    larger = lens.resized(factor * lens.width, factor * lens.height)
    images = tuple(replace(image, intrinsics=larger) for image in scene.images)
    of_larger = scene.replace(images=images, intrinsics=(larger,))
    assert check_poses(of_larger, of_larger.images) == check_poses(scene, scene.images)
    error = estimate_pose_error(of_larger, of_larger.images)
    assert error == estimate_pose_error(scene, scene.images)
    assert error.exact
    assert error.side == 160


@pytest.fixture
def three_photographs(monkeypatch):
    """Fewer to measure, as each is measured with 17 focal lengths."""
    monkeypatch.setattr(module, "POSE_ACCURACY", replace(module.POSE_ACCURACY, photographs=3))


@pytest.mark.usefixtures("three_photographs")
@pytest.mark.parametrize("factor", [0.5, 1.6])
def test_focal_lengths_of_another_size_are_found_without_points(room, poses, factor):
    bare = _posed(room, poses)
    assert not find_focal_length(bare, bare.images, estimate_pose_error(bare, bare.images))

    def scaled(lens):
        fx, fy, cx, cy = lens.params
        return replace(lens, params=(factor * fx, factor * fy, cx, cy))

    images = tuple(replace(im, intrinsics=scaled(im.intrinsics)) for im in bare.images)
    scene = bare.replace(images=images)
    (finding,) = find_focal_length(scene, images, estimate_pose_error(scene, images))
    assert (finding.kind, finding.severity) == ("wrong-focal-length", "error")
    right = float(finding.fix.partition("about ")[2].partition(" px")[0])
    assert right == pytest.approx(room.images[0].intrinsics.params[0], rel=0.1)


@pytest.mark.usefixtures("three_photographs")
def test_inexact_poses_are_not_taken_for_focal_lengths(room, poses):
    axes = np.random.default_rng(0).normal(size=(len(poses), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turned = np.tile(np.eye(4), (len(poses), 1, 1))
    turned[:, :3, :3] = Rotation.from_rotvec(np.radians(1.0) * axes).as_matrix()
    scene = _posed(room, turned @ poses)
    error = estimate_pose_error(scene, scene.images)
    assert not error.exact
    assert not find_focal_length(scene, scene.images, error)
