"""Camera paths of nerfstudio's viewer: what they ask for."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.errors import SceneFormatError
from splatseed.similarity import Similarity
from splatseed.viewer.camera_path import read_camera_path

CONTENT = {"camera_type": "perspective", "render_width": 1920, "render_height": 1080, "fps": 24}
EYE = [1.0, 0, 0, 2, 0, 1, 0, 3, 0, 0, 1, 4, 0, 0, 0, 1]
CROP = {
    "crop_center": [1.0, 0, 0],
    "crop_scale": [4.0, 2, 2],
    "crop_rot": [0.0, 0, np.pi / 2],  # roll, pitch, yaw
    "crop_bg_color": {"r": 26, "g": 230, "b": 51},
}


def _path(tmp_path, frames=2, frame=None, **more):
    """Write a path whose frames look along -z from (2, 3, 4)."""
    each = {"camera_to_world": EYE, "fov": 90, "aspect": 16 / 9, **(frame or {})}
    (tmp_path / "path.json").write_text(
        json.dumps({**CONTENT, "camera_path": [each] * frames, **more})
    )
    return read_camera_path(tmp_path / "path.json")


def test_a_path_is_read_as_nerfstudio_renders_it(tmp_path):
    path = _path(tmp_path)
    assert (path.size, path.fps) == ((1920, 1080), 24)
    assert _path(tmp_path, seconds=0.5).fps == 4  # ns-render's: frames / seconds
    first, _ = path.views((1920, 1080))
    # three.js: half the height over the tangent of half the field of view.
    np.testing.assert_allclose(first.K, [[540, 0, 960], [0, 540, 540], [0, 0, 1]])
    np.testing.assert_allclose(first.camera.center, [2, 3, 4])
    np.testing.assert_allclose(first.cam_from_world[2, :3], [0, 0, -1])
    assert path.findings((1920, 1080), 0, 0) == []
    for size in ((1080, 1080), (1920, 1079)):
        (found,) = path.findings(size, 0, 0)
        assert found.kind == "path-not-followed"


def test_a_crop_box_is_turned_about_its_centre(tmp_path):
    """Yaw by 90 degrees: the box's long side, 4 along its x, lies along y."""
    crop = _path(tmp_path, crop=CROP).crop
    places = [[1, 1.9, 0], [1, -1.9, 0], [1.9, 0, 0], [1, 2.1, 0], [2.1, 0, 0], [1, 0, 1.1]]
    assert crop.contains(np.array(places)).tolist() == [True, True, True, False, False, False]
    assert crop.background == (26, 230, 51)
    old = {key: value for key, value in CROP.items() if key != "crop_rot"}  # before version 1
    assert _path(tmp_path, crop=old).crop.contains(np.array([[2.9, 0, 0]])).all()


def test_a_crop_box_rolls_first_then_pitches(tmp_path):
    """nerfstudio: ``SO3.from_rpy_radians``, yaw @ pitch @ roll; y turns to z, then on to x."""
    turned = {**CROP, "crop_center": [0.0, 0, 0], "crop_scale": [2.0, 6, 2]}
    turned["crop_rot"] = [np.pi / 2, np.pi / 2, 0.0]
    crop = _path(tmp_path, crop=turned).crop
    inside = crop.contains(np.array([[2.9, 0, 0], [0, 2.9, 0], [0, 0, 2.9]]))
    assert inside.tolist() == [True, False, False]


def test_a_crop_box_is_in_the_paths_world(tmp_path, run_folder):
    from splatseed.splat.formats import read_gaussians

    model = read_gaussians(run_folder / "point_cloud.ply")
    middle = np.median(model.means, axis=0).astype(float)
    world = Similarity(0.1, np.eye(3), np.array([5.0, 0, 0]))
    crop = {**CROP, "crop_center": (0.1 * middle + [5.0, 0, 0]).tolist(), "crop_rot": [0.0, 0, 0]}
    crop["crop_scale"] = [0.1, 10.0, 10.0]
    path = _path(tmp_path, crop=crop)
    kept = path.cropped(model, world)
    assert 0 < len(kept) < len(model)
    assert np.abs(kept.means[:, 0] - middle[0]).max() < 0.5  # half of 0.1, in a tenth of the scale
    with pytest.raises(SceneFormatError, match="crop box"):
        path.cropped(model)


@pytest.mark.parametrize("where", ["file", "frame"])
@pytest.mark.parametrize("kind", ["equirectangular", "orthographic", "Fisheye", "vr180"])
def test_other_cameras_are_refused_by_name(tmp_path, kind, where):
    said = {"camera_type": kind}
    more = said if where == "file" else {"frame": said}
    with pytest.raises(SceneFormatError, match=f"'{kind}'.*Perspective"):
        _path(tmp_path, **more)


@pytest.mark.parametrize(
    "more",
    [
        {"frames": 0},
        {"frame": {"camera_to_world": [1, 2]}},
        {"frame": {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 5, 0, 0, 0, 0, 1]}},
        {"frame": {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]}},
        {"frame": {"fov": 200}},
        {"seconds": 1e-9},
        {"render_width": 1e9},
        {"crop": {**CROP, "crop_scale": [0.0, 1, 1]}},
        {"crop": {"crop_center": [0, 0, 0]}},
        {"crop": [1]},
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, more):
    with pytest.raises(SceneFormatError, match=r"path\.json"):
        _path(tmp_path, **more)


def test_a_file_that_is_no_path_is_refused(tmp_path):
    (tmp_path / "path.json").write_text("[]")
    with pytest.raises(SceneFormatError, match=r"path\.json"):
        read_camera_path(tmp_path / "path.json")
