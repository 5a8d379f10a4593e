"""Cameras against the definition of projection, and against pycolmap."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed.camera import (
    CAMERA_MODELS,
    MODELS,
    Camera,
    Intrinsics,
    quat_from_rotation,
    rotation_from_quat,
)
from splatseed.errors import SceneFormatError

QUATS = hnp.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(
    lambda quat: np.linalg.norm(quat) > 1e-3
)
K = np.array([[300.0, 0, 160], [0, 310.0, 120], [0, 0, 1]])


def _camera(quat, translation=(0.3, -0.2, 4.0)):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_quat(np.asarray(quat, float)), translation
    return Camera(K, 320, 240, pose)


@given(QUATS)
def test_quaternions_round_trip(quat):
    unit, rotation = quat / np.linalg.norm(quat), rotation_from_quat(quat)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    back = quat_from_rotation(rotation)
    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1)
    assert abs(back @ unit) == pytest.approx(1, abs=1e-12)  # q and -q turn alike


def test_an_inexact_rotation_gives_the_nearest_quaternion(rng):
    exact = rotation_from_quat(rng.normal(size=4))
    quat = quat_from_rotation(exact + 1e-6 * rng.normal(size=(3, 3)))
    np.testing.assert_allclose(rotation_from_quat(quat), exact, atol=1e-5)


@given(QUATS)
def test_unproject_inverts_project(quat):
    camera = _camera(quat)
    rng = np.random.default_rng(0)
    uv, depth = rng.uniform(0, [320, 240], (20, 2)), rng.uniform(0.5, 9, 20)
    back_uv, back_depth = camera.project(camera.unproject(uv, depth))
    np.testing.assert_allclose(back_uv, uv, atol=1e-8)
    np.testing.assert_allclose(back_depth, depth, atol=1e-9)


def test_points_behind_the_camera_have_no_pixel():
    camera = _camera([1, 0, 0, 0], (0, 0, 0))
    uv, depth = camera.project(np.array([[0, 0, -1.0], [1, 1, 0], [0, 0, 1]]))
    assert np.isnan(uv[:2]).all()
    np.testing.assert_array_equal(depth, [-1, 0, 1])
    np.testing.assert_array_equal(uv[2], [160, 120])


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_models_match_colmap(name):
    model = CAMERA_MODELS[name]
    theirs = pycolmap.Camera.create_from_model_name(1, name, 500.0, 640, 480)
    numbers = len(theirs.params), len(theirs.focal_length_idxs())
    assert model == (int(theirs.model), name, *numbers)
    params = [*theirs.params[: model.num_focal + 2], *[0.01] * len(theirs.extra_params_idxs())]
    ours = Intrinsics(1, name, 640, 480, tuple(params))
    np.testing.assert_allclose(ours.K, theirs.calibration_matrix())
    theirs.params = params
    if not ours.is_fisheye:  # a fisheye without coefficients counts as undistorted there
        assert ours.has_distortion == (not theirs.is_undistorted())
        assert ours.is_pinhole == theirs.is_undistorted()
    assert (ours.pinhole.model, ours.pinhole.K.tolist()) == ("PINHOLE", ours.K.tolist())


def test_all_of_pycolmaps_models_are_known():
    ids = {str(name): int(model) for name, model in pycolmap.CameraModelId.__members__.items()}
    del ids["INVALID"]
    assert {model.name: model.model_id for model in MODELS.values()} == ids


def test_a_panorama_has_a_size_and_no_matrix():
    panorama = Intrinsics(1, "EQUIRECTANGULAR", 64, 32, (64.0, 32.0))
    assert panorama.is_panorama
    assert panorama.has_distortion
    assert np.isnan(panorama.K).all()
    assert panorama.resized(32, 16).params == (32, 16)


def test_projection_matches_pycolmap(rng):
    ours = _camera([0.9, 0.1, -0.2, 0.3])
    pose = pycolmap.Rigid3d(ours.cam_from_world[:3])
    theirs = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[300, 310, 160, 120])
    xyz = rng.normal(size=(50, 3))
    uv, _ = ours.project(xyz)
    expected = np.array([theirs.img_from_cam(pose * point) for point in xyz])
    np.testing.assert_allclose(uv, expected.reshape(-1, 2), rtol=1e-9)


@pytest.mark.parametrize(
    ("model", "params", "named"),
    [
        ("POLAROID", (1.0,) * 4, "'POLAROID'"),
        ("EQUIRECTANGULAR", (9.0, 5.0, 1.0), "2 parameters; found 3"),
        ("PINHOLE", (1.0,) * 3, "4 parameters; found 3"),
    ],
)
def test_invalid_records_are_refused(model, params, named):
    with pytest.raises(SceneFormatError, match=named) as error:
        Intrinsics(17, model, 10, 10, params)
    assert "camera 17" in str(error.value)
