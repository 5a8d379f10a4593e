"""Given cameras: whose they are, their sizes and the names of their pictures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatseed.errors import SceneFormatError
from splatseed.io import load_scene
from splatseed.photos.view import camera_views
from splatseed.photos.visibility import points_in_image
from splatseed.splat.formats import read_gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.viewer.cameras import read_cameras
from splatseed.viewer.models import ViewerItem, viewer_frame


def _graphdeco(camera, **more):
    """A record as graphdeco's code writes it: rotation and centre of ``world_from_cam``."""
    pose = np.linalg.inv(camera.cam_from_world)
    return {
        "id": 0, "img_name": "frame.01", "width": camera.width, "height": camera.height,
        "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(),
        "fx": camera.K[0, 0], "fy": camera.K[1, 1], **more,
    }  # fmt: skip


def test_graphdecos_cameras_have_their_size_and_name(room, tmp_path):
    camera = load_scene(room).images[2].camera
    records = [_graphdeco(camera), _graphdeco(camera, id=1, width=50, height=30)]
    (tmp_path / "cameras.json").write_text(json.dumps(records))
    given = read_cameras(tmp_path / "cameras.json")
    first, second = given.views
    np.testing.assert_allclose(first.cam_from_world, camera.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(second.K[:2, 2], [25, 15])
    assert not given.of_scene
    assert [view.name for view in given.views] == ["00000_frame.01.png", "00001_frame.01.png"]
    (tmp_path / "cameras.json").write_text(json.dumps(records[:1]))
    assert read_cameras(tmp_path / "cameras.json").views[0].name == "frame.01.png"
    for wrong in ({"fx": 0}, {"rotation": np.zeros((3, 3)).tolist()}, {"width": "wide"}):
        (tmp_path / "cameras.json").write_text(json.dumps([_graphdeco(camera, **wrong)]))
        with pytest.raises(SceneFormatError, match="graphdeco"):
            read_cameras(tmp_path / "cameras.json")


def test_distortion_is_said_to_be_left_out(tmp_path, monkeypatch):
    """Cameras of photographs that do not exist yet, as one writes them to render."""
    monkeypatch.chdir(tmp_path)
    lens = {"w": 64, "h": 48, "fl_x": 50, "fl_y": 51, "cx": 30, "cy": 25, "k1": 0.1}
    frame = {"file_path": "new/a.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "new.json").write_text(json.dumps({**lens, "frames": [frame]}))
    given = read_cameras(Path("new.json"))
    assert [each.kind for each in given.findings] == ["ignored-distortion"]
    (view,) = given.views
    np.testing.assert_allclose(view.K, [[50, 0, 30], [0, 51, 25], [0, 0, 1]])
    assert (view.name, view.width, view.height) == ("a.png", 64, 48)


def test_flight_renders_given_cameras_by_name(room, run_folder, tmp_path, splatseed):
    """A model of a file alone, from the cameras of a COLMAP model without its photographs."""
    shutil.copytree(room / "sparse/0", tmp_path / "model")
    said = splatseed(
        "flight", run_folder / "point_cloud.ply", "--cameras", tmp_path / "model",
        "-o", tmp_path / "renders",
    )  # fmt: skip
    assert said.code == 0, said.err
    scene, gaussians = load_scene(room), read_gaussians(run_folder / "point_cloud.ply")
    renderer = ModelRenderer(gaussians, viewer_frame(ViewerItem("", None, gaussians)))
    pictures = sorted(path.name for path in (tmp_path / "renders").glob("*.png"))
    assert pictures == [image.name.replace(".jpg", ".png") for image in scene.images]
    for image, name in list(zip(scene.images, pictures, strict=True))[::5]:
        shown = np.array(Image.open(tmp_path / "renders" / name)) / 255
        wanted = renderer.color(camera_views([image])[0])
        assert np.abs(shown - wanted).mean() < 0.002
    # A second time only if asked to.
    words = ("flight", run_folder, "--cameras", room, "-o", tmp_path / "renders")
    assert splatseed(*words).code == 2
    assert splatseed(*words, "--overwrite").code == 0
    said = splatseed(*words, "--overwrite", "--exclude", "view_00*")
    assert "10 photographs are left out: view_000.png" in said.err
    fewer = [name for name in pictures if not name.startswith("view_00")]
    assert sorted(path.name for path in (tmp_path / "renders").glob("*.png")) == fewer


def test_a_path_shows_its_crop_box_before_its_background(room, run_folder, tmp_path, splatseed):
    camera = load_scene(room).images[3].camera
    means = read_gaussians(run_folder / "point_cloud.ply").means
    seen = points_in_image(camera, means).point_idx
    middle = float(np.median(means[seen, 0]))
    pose = np.linalg.inv(camera.cam_from_world) @ np.diag([1.0, -1, -1, 1])
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.K[1, 1]))
    crop = {"crop_center": [middle - 50, 0, 0], "crop_scale": [100.0, 99, 99]}  # x below middle
    crop |= {"crop_rot": [0.0, 0, 0], "crop_bg_color": {"r": 26, "g": 230, "b": 51}}
    content = {
        "camera_path": [{"camera_to_world": pose.ravel().tolist(), "fov": fov}] * 2,
        "render_width": 95, "render_height": 71, "crop": crop,
    }  # fmt: skip
    (tmp_path / "path.json").write_text(json.dumps(content))
    said = splatseed("flight", run_folder, "--path", tmp_path / "path.json", "-o", tmp_path / "a")
    assert said.code == 0, said.err
    assert f"of {len(means):,} Gaussians, those in its crop box" in said.err
    picture = np.array(Image.open(tmp_path / "a/00001.png"))
    assert picture.shape == (71, 95, 3)  # as asked for, though odd
    empty = (picture == [26, 230, 51]).all(axis=2)
    assert 0.01 < empty.mean() < 0.9


def test_a_video_needs_cameras_of_one_size(room, run_folder, tmp_path, splatseed):
    camera = load_scene(room).images[2].camera
    records = [_graphdeco(camera), _graphdeco(camera, width=50, height=30)]
    (tmp_path / "cameras.json").write_text(json.dumps(records))
    words = ("flight", run_folder, "--cameras", tmp_path / "cameras.json", "-o", tmp_path / "a.mp4")
    said = splatseed(*words)
    assert (said.code, "one size" in said.err) == (2, True)
    assert splatseed(*words, "--size", "48x36").code == 0
