"""The check-up: right captures are left alone, and faults that tools make are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.checkup import examination
from splatseed.checkup.examination import (
    UNFIT_POINTS,
    WRONG_FOCAL_LENGTH,
    CheckUp,
    comparable,
    describe_affine,
    examine,
    with_fitting_points,
)
from splatseed.checkup.poses import CORRECTIONS
from splatseed.checkup.wrong_poses import WRONG_POSES, find_wrong_poses, without_wrong_poses
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.findings import Finding
from splatseed.pointcloud import PointCloud
from splatseed.seeding.upsampling import upsample

pytestmark = pytest.mark.usefixtures("compare_once")  # of the same photographs at the same poses


def _with_pose(image, pose):
    return replace(image, quat=quat_from_rotation(pose[:3, :3]), translation=pose[:3, 3])


def _with_positions(scene, xyz):
    points = scene.points.replace(xyz=np.asarray(xyz, np.float32), normals=None)
    return scene.replace(points=points, tracks=None)


def _with_focal(scene, factor):
    def scaled(image):
        lens = image.intrinsics
        assert lens.model == "PINHOLE"
        params = (*(factor * each for each in lens.params[:2]), *lens.params[2:])
        return replace(image, intrinsics=replace(lens, params=params))

    return scene.replace(images=tuple(map(scaled, scene.images)))


def _kinds(findings):
    return [finding.kind for finding in findings]


@pytest.mark.parametrize("tracked", [True, False])
def test_points_that_photographs_confirm_fit(room, tracked):
    scene = room if tracked else room.replace(tracks=None)
    checkup = examine(scene, comparable(scene))
    assert checkup.confirms_poses
    assert not checkup.findings
    assert checkup.fit.support > 0.3


def test_colours_are_not_needed(room):
    black = room.points.replace(rgb=np.zeros_like(room.points.rgb))
    checkup = examine(room.with_points(black), comparable(room))
    assert checkup.confirms_poses
    assert np.isnan(checkup.fit.color_error)


def test_hidden_points_without_tracks_are_passed_over(room, rng):
    """Colours tell them apart from visible ones, where a coarse z-buffer does not."""
    behind = 1.6 * (room.points.xyz - room.images[0].camera.center) + room.images[0].camera.center
    hidden = PointCloud(behind.astype(np.float32), rng.permutation(room.points.rgb))
    alone = examine(room.replace(tracks=None), comparable(room)).fit
    both = room.with_points(PointCloud.concatenate(room.points, hidden)).replace(tracks=None)
    mixed = examine(both, comparable(both))
    assert mixed.confirms_poses
    assert mixed.fit.support > 0.8 * alone.support


def test_the_same_is_found_in_any_unit(room):
    images = tuple(replace(each, translation=1000 * each.translation) for each in room.images)
    scene = _with_positions(room, 1000.0 * room.points.xyz).replace(images=images)
    assert examine(scene, comparable(scene)).confirms_poses


@pytest.mark.parametrize("name", [*CORRECTIONS][::3])  # tests/checkup/test_poses.py has all
def test_poses_of_another_convention_are_refused_as_without_points(room, name):
    images = tuple(_with_pose(im, CORRECTIONS[name](im.cam_from_world)) for im in room.images)
    scene = room.replace(images=images, tracks=None)
    with pytest.raises(SceneFormatError) as caught:
        examine(scene, comparable(scene))
    with pytest.raises(SceneFormatError) as without_points:
        upsample(scene.with_points(PointCloud.empty()))
    assert str(caught.value) == str(without_points.value)


@pytest.mark.parametrize("factor", [0.5, 1.25])
def test_the_focal_length_of_another_size_is_named(room, factor):
    scene = _with_focal(room, factor)
    checkup = examine(scene, comparable(scene))
    assert _kinds(checkup.findings) == [WRONG_FOCAL_LENGTH]
    right = float(checkup.findings[0].fix.partition("about ")[2].partition(" px")[0])
    assert right == pytest.approx(room.images[0].intrinsics.params[0], rel=0.04)


def test_points_in_other_axes_are_moved_on_request(room, monkeypatch):
    axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up
    scene = _with_positions(room, room.points.xyz @ axes.T)
    checkup = examine(scene, comparable(scene))
    assert checkup.points == "unfit"
    np.testing.assert_array_equal(checkup.scene_from_points[:, :3], axes.T)
    monkeypatch.setattr(examination, "examine", lambda *_: checkup)  # once is enough
    moved, findings = with_fitting_points(scene, "move")
    assert _kinds(findings) == ["transformed-points"]
    np.testing.assert_allclose(moved.points.xyz, room.points.xyz, atol=1e-5)
    dropped, findings = with_fitting_points(scene)
    assert _kinds(findings) == [UNFIT_POINTS]
    assert not len(dropped.points)
    kept, findings = with_fitting_points(scene, "keep")
    assert kept is scene
    assert _kinds(findings) == [UNFIT_POINTS]


def test_random_points_are_no_seeds(room, rng):
    low, high = np.percentile(room.points.xyz, [5, 95], axis=0)
    scene = _with_positions(room, rng.uniform(low, high, room.points.xyz.shape))
    notes = []
    cloud = upsample(scene, note=notes.append)
    assert UNFIT_POINTS in _kinds(notes)
    assert not cloud.num_original


def test_methods_that_interpolate_keep_the_points(room, monkeypatch):
    unfit = CheckUp("unfit", findings=(Finding(UNFIT_POINTS, "They do not fit.", "error"),))
    monkeypatch.setattr(examination, "examine", lambda *_: unfit)
    notes = []
    cloud = upsample(room, "linear", ratio=2, note=notes.append)
    assert cloud.num_original == len(room.points)
    assert UNFIT_POINTS in _kinds(notes)


def test_single_wrong_poses_are_named_and_left_out(room):
    images = list(room.images)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("y", 5, degrees=True).as_matrix()
    images[6] = _with_pose(images[6], turn @ images[6].cam_from_world)
    scene = room.replace(images=tuple(images))
    findings = find_wrong_poses(scene, comparable(scene))
    assert _kinds(findings) == [WRONG_POSES]
    assert findings[0].subjects == (images[6].name,)
    left, _ = without_wrong_poses(scene)
    assert {image.name for image in scene.images} - {image.name for image in left.images} == {
        images[6].name
    }
    assert left.absent == (images[6].name,)
    assert not find_wrong_poses(room, comparable(room))


def test_too_few_points_or_photographs_show_nothing(room):
    assert examine(room, comparable(room)[:1]).points == "unclear"
    few = room.with_points(room.points.select(np.arange(len(room.points)) < 20))
    assert examine(few, comparable(few)).points == "unclear"


def test_cameras_that_only_turn_show_nothing(room):
    center = room.images[0].camera.center

    def turned(image):
        pose = image.cam_from_world.copy()
        pose[:3, 3] = -pose[:3, :3] @ center
        return _with_pose(image, pose)

    scene = room.replace(images=tuple(map(turned, room.images)), tracks=None)
    assert examine(scene, comparable(scene)).points == "unclear"


def test_an_unknown_choice_is_refused(room):
    with pytest.raises(ParameterError, match="unfit_points"):
        with_fitting_points(room, "ignore")


def test_affine_maps_are_described_in_words():
    affine = np.array([[0.5, 0, 0, 1.0], [0, 0, -0.5, 0], [0, 0.5, 0, -2]])
    said = describe_affine(affine)
    assert said == "once x, y, z are x, -z, y and they are scaled by 0.5 and shifted by 1, 0, -2"
