"""Camera paths: past the cameras, smooth, upright; files of nerfstudio's mean what they say."""

from __future__ import annotations

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="rendering needs PyTorch")

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io import load_scene
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.ply import read_gaussians
from splatseed.viewer.frames import depth_colors, split_picture
from splatseed.viewer.paths import focus_of, orbit, path_of_file, smooth_path
from splatseed.viewer.renderer import ModelRenderer, model_frame
from splatseed.viewer.shown import open_shown
from splatseed.viewer.video import even_size
from splatseed.views.view import View, poses_of
from splatseed.views.viewpoint import look_at

UP = np.array([0.0, 0.0, 1.0])


def _ring(count=24, radius=3.0, height=1.0):
    """Cameras in a ring that look at the origin."""
    views = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        K = np.array([[100.0, 0, 60], [0, 100.0, 45], [0, 0, 1]])
        pose = look_at(eye, np.zeros(3), UP)
        views.append(View(f"{i:03}", np.empty((0, 0, 3), np.uint8), K, 120, 90, pose))
    return views


def _centers(views):
    return np.array([-v.cam_from_world[:3, :3].T @ v.cam_from_world[:3, 3] for v in views])


def test_a_path_follows_the_cameras_evenly(rng):
    cameras = _ring()
    path = smooth_path(cameras, 90, (160, 90))
    centers = _centers(path)
    assert len(path) == 90
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 3, atol=0.15)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.min()
    for view in path:
        rotation = view.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert (-rotation[1] @ UP) > 0.9
    assert (path[0].width, path[0].height) == (160, 90)
    np.testing.assert_allclose(path[0].K[:2, 2], [80, 45])
    # Names in no order: it goes from neighbour to neighbour.
    shuffled = [
        v.__class__(**{**v.__dict__, "name": f"{i}"})
        for i, v in zip(rng.permutation(24), cameras, strict=True)
    ]
    again = _centers(smooth_path(shuffled, 90, (160, 90)))
    assert np.linalg.norm(np.diff(again, axis=0), axis=1).max() < 2 * steps.max()


def test_an_orbit_goes_around_what_the_cameras_look_at(run_folder):
    cameras = _ring()
    np.testing.assert_allclose(focus_of(cameras), 0, atol=0.1)
    gaussians = read_gaussians(run_folder / "point_cloud.ply")
    centers = _centers(orbit(cameras, gaussians, 60, (160, 90)))
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 3, atol=0.2)
    np.testing.assert_allclose(centers[:, 2], 1, atol=0.1)
    assert len(orbit([], gaussians, 7, (64, 48))) == 7  # a model alone has a way around it too


@pytest.mark.parametrize("count", [0, 1])
def test_no_path_goes_through_one_camera(count):
    with pytest.raises(ParameterError, match="two places"):
        smooth_path(_ring()[:count], 10, (64, 48))


def test_nerfstudios_paths_are_opengl_cameras(tmp_path):
    world_from_gl = np.eye(4)
    world_from_gl[:3, 3] = (1, 2, 3)
    frame = {"camera_to_world": world_from_gl.reshape(-1).tolist(), "fov": 90.0, "aspect": 1.5}
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"camera_path": [frame, frame], "fps": 24}))
    (view, _), fps = path_of_file(path, (150, 100))
    assert (fps, view.width, view.height) == (24, 150, 100)
    np.testing.assert_allclose(view.K, [[50, 0, 75], [0, 50, 50], [0, 0, 1]], atol=1e-9)
    # OpenGL looks along -z: what lies there is in front.
    np.testing.assert_allclose(view.cam_from_world @ [1, 2, -7, 1], [0, 0, 10, 1], atol=1e-9)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        '{"camera_path": []}',
        '{"camera_path": [{"camera_to_world": [1, 2]}]}',
        '{"camera_path": [{"camera_to_world": [1,0,0,0,0,1,0,0,0,0,5,0,0,0,0,1]}]}',
        '{"camera_path": [{"camera_to_world": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], "fov": 200}]}',
    ],
)
def test_what_is_no_path_is_refused(content, tmp_path):
    (tmp_path / "path.json").write_text(content)
    with pytest.raises(SceneFormatError, match="camera path"):
        path_of_file(tmp_path / "path.json", (64, 48))


def test_depth_is_that_of_a_wall():
    """A wall of Gaussians 4 units ahead, in a world 100 units large."""
    xy = np.stack(np.meshgrid(*2 * [np.linspace(-4, 4, 41)]), axis=-1).reshape(-1, 2)
    count = len(xy)
    wall = Gaussians(
        means=np.column_stack([xy, np.full(count, 4.0)]).astype(np.float32) + np.float32(100),
        scales=np.full((count, 3), np.log(0.15), np.float32) + np.array([0, 0, -3], np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacities=np.full(count, 4, np.float32),
        sh0=np.zeros((count, 1, 3), np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
    )
    pose = np.eye(4)
    pose[:3, 3] = -100
    view = View(
        "",
        np.empty((0, 0, 3), np.uint8),
        np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]),
        64,
        48,
        pose,
    )
    renderer = ModelRenderer(wall, model_frame(wall, None))
    np.testing.assert_allclose(renderer.depth(view), 4, atol=0.02)
    np.testing.assert_allclose(renderer.color(view), 0.5, atol=0.03)


def test_sizes_are_even_and_pictures_split_where_asked():
    assert even_size(271, 481) == (272, 480)
    assert even_size(4000, 3000, 1280) == (1280, 960)
    red, blue = np.zeros((20, 40, 3), np.uint8), np.zeros((20, 40, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    split = split_picture(red, blue, at=0.25)
    assert (split[:, :9, 0] == 255).all()
    assert (split[:, 12:, 2] == 255).all()
    colors = depth_colors(np.array([[0.0, 1.0, 2.0]], np.float32), (1.0, 2.0))
    assert colors[0, 0].sum() == 0 < colors[0, 1].sum()


def test_what_is_shown_is_what_the_file_holds(room, run_folder):
    assert open_shown(room).gaussians is None
    run = open_shown(run_folder)
    assert len(run.scene.images) == 12
    assert len(run.gaussians) == len(load_scene(room).points)
    points = open_shown(room / "sparse/0/points3D.ply")
    assert points.gaussians is None
    model = open_shown(run_folder / "point_cloud.ply")
    assert (model.scene, len(model.gaussians)) == (None, len(run.gaussians))
    assert len(poses_of(run.scene.images)) == 12
