"""Flights: smooth, upright paths past the cameras, and readable videos."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="rendering needs PyTorch")
ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg (extra view)")

from splatseed.camera import Camera, quat_from_rotation
from splatseed.errors import ParameterError
from splatseed.io import load_scene, write_scene
from splatseed.photos.view import NO_PIXELS, View, camera_views
from splatseed.photos.viewpoint import look_at
from splatseed.similarity import Similarity
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import find_transform, transform_gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.viewer import flights
from splatseed.viewer.flights import orbit, smooth_path
from splatseed.viewer.models import ViewerItem, open_item, pinhole_view, split_picture, viewer_frame

UP = np.array([0.0, 0.0, 1.0])


def _ring(count=24, radius=3.0, height=1.0):
    """Cameras in a ring that look at the origin."""
    views = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        K = np.array([[100.0, 0, 60], [0, 100.0, 45], [0, 0, 1]])
        pose = look_at(eye, np.zeros(3), UP)
        views.append(View(f"{i:03}", NO_PIXELS, Camera(K, 120, 90, pose)))
    return views


def _centers(views):
    return np.array([-v.cam_from_world[:3, :3].T @ v.cam_from_world[:3, 3] for v in views])


# Paths --------------------------------------------------------------------------------------------


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
    # Numbers in names that are not padded: 10 comes after 9.
    unpadded = [dataclasses.replace(v, name=f"{i}.jpg") for i, v in enumerate(cameras)]
    np.testing.assert_allclose(_centers(smooth_path(unpadded, 90, (160, 90))), centers)
    # Names in no order: it goes from neighbour to neighbour.
    names = rng.permutation(24)
    shuffled = [dataclasses.replace(v, name=f"{i}") for i, v in zip(names, cameras, strict=True)]
    again = _centers(smooth_path(shuffled, 90, (160, 90)))
    assert np.linalg.norm(np.diff(again, axis=0), axis=1).max() < 2 * steps.max()
    with pytest.raises(ParameterError, match="path"):
        smooth_path(cameras[:1], 10, (64, 48))


def test_an_orbit_circles_the_focus_of_the_cameras(run_folder):
    cameras = _ring()
    np.testing.assert_allclose(flights.focus_point(cameras), 0, atol=0.1)
    gaussians = read_gaussians(run_folder / "point_cloud.ply")
    centers = _centers(orbit(cameras, gaussians, 60, (160, 90)))
    np.testing.assert_allclose(np.linalg.norm(centers[:, :2], axis=1), 3, atol=0.2)
    np.testing.assert_allclose(centers[:, 2], 1, atol=0.1)
    assert len(orbit([], gaussians, 7, (64, 48))) == 7  # a model alone has a way around it too
    one = gaussians.select(np.zeros(3, int))  # all in one place
    apart = _centers(orbit([], one, 7, (64, 48))) - one.means[0]
    assert (np.linalg.norm(apart, axis=1) > 3 * np.exp(one.scales[0].max())).all()
    assert np.isfinite(apart).all()


def _wall(at):
    """Gaussians of a wall 8 wide, across x at this y."""
    xz = np.stack(np.meshgrid(*2 * [np.linspace(-4, 4, 21)]), axis=-1).reshape(-1, 2)
    means = np.insert(xz, 1, at, axis=1).astype(np.float32)
    ones = np.ones((len(means), 1), np.float32)
    return Gaussians(
        means=means, scales=-2 * ones * np.float32([1, 1, 1]), opacities=4 * ones[:, 0],
        quats=ones * np.float32([1, 0, 0, 0]), sh0=np.zeros((len(means), 1, 3), np.float32),
        shN=np.zeros((len(means), 0, 3), np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("converging", [True, False])
def test_an_orbit_stays_where_cameras_look_from(converging):
    """A capture of a wall: cameras side by side that look at it, slightly down."""
    views = []
    for i, x in enumerate(np.linspace(-1, 1, 9)):
        eye = np.array([x, -0.3 * (i % 2), 1.5])
        target = np.array([0 if converging else x, 5, 0])
        pose = look_at(eye, target, UP)
        K = np.array([[100.0, 0, 60], [0, 100.0, 45], [0, 0, 1]])
        views.append(View(f"{i:03}", NO_PIXELS, Camera(K, 120, 90, pose)))
    notes = []
    path = orbit(views, _wall(5.0), 40, (120, 90), note=notes.append)
    assert [each.kind for each in notes] == ["orbit-swings"]
    centers, known = _centers(path), _centers(views)
    near = np.linalg.norm(centers[:, None] - known[None], axis=2).min(axis=1)
    assert near.max() < 0.6
    assert np.ptp(centers[:, 0]) > 1
    # Both ends meet, so that the video can be repeated.
    assert np.linalg.norm(centers[0] - centers[-1]) < 0.3
    for view in path:
        assert view.cam_from_world[2, 1] > 0.9  # it looks at the wall
        # With a level horizon; parallel cameras do not know whether they look down.
        assert abs(view.cam_from_world[0] @ [0, 0, 1, 0]) < 0.015 or not converging
    level = orbit(views, _wall(5.0), 4, (120, 90), up=np.array([0.0, 0.6, 0.8]))
    assert all(abs(view.cam_from_world[0, :3] @ [0, 0.6, 0.8]) < 1e-9 for view in level)


def test_an_orbit_of_two_sides_stays_on_the_larger():
    ring = _ring(36)
    path = orbit([*ring[:9], *ring[18:20]], _wall(0.0), 40, (120, 90))
    angles = np.degrees(np.arctan2(*_centers(path)[:, 1::-1].T))
    assert (angles.min() > -5, angles.max() < 85) == (True, True)
    full = _centers(orbit(ring[::6], _wall(0.0), 40, (120, 90)))
    assert np.ptp(np.arctan2(full[:, 1], full[:, 0])) > 6


def _sideways(scene):
    """The scene as a phone stores it that was held upright: tall photographs, turned to be wide."""
    quarter = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # the top of an image becomes its left
    (lens,) = {image.intrinsics for image in scene.images}
    fx, fy, cx, cy = lens.params
    wide = dataclasses.replace(
        lens, width=lens.height, height=lens.width, params=(fy, fx, cy, lens.width - cx)
    )
    images = tuple(
        dataclasses.replace(
            image,
            intrinsics=wide,
            quat=quat_from_rotation(quarter @ image.cam_from_world[:3, :3]),
            translation=quarter @ image.translation,
        )
        for image in scene.images
    )
    return scene.replace(images=images, depths=None)


def test_the_path_past_sideways_cameras_is_that_past_upright_ones(room):
    scene = load_scene(room)
    flights_of = []
    for each in (scene, _sideways(scene)):
        views = ViewerItem("", each).central_views
        assert (views[0].width, views[0].height) == (96, 72)
        flights_of.append(smooth_path(views, 12, (96, 72)))
    for view, other in zip(*flights_of, strict=True):
        np.testing.assert_allclose(view.cam_from_world, other.cam_from_world, atol=1e-6)
        np.testing.assert_allclose(view.K, other.K, atol=1e-6)


# Renders ------------------------------------------------------------------------------------------


def test_depth_of_a_wall():
    """A wall of Gaussians 4 units ahead, in a world 100 units large."""
    xy = np.stack(np.meshgrid(*2 * [np.linspace(-4, 4, 41)]), axis=-1).reshape(-1, 2)
    ones = np.ones((len(xy), 1), np.float32)
    wall = Gaussians(
        means=np.float32([100, 100, 104]) + np.hstack([xy, 0 * ones]).astype(np.float32),
        scales=ones * np.float32([np.log(0.15), np.log(0.15), np.log(0.15) - 3]),
        quats=ones * np.float32([1, 0, 0, 0]),
        opacities=4 * ones[:, 0],
        sh0=np.zeros((len(xy), 1, 3), np.float32),
        shN=np.zeros((len(xy), 0, 3), np.float32),
    )
    pose = np.eye(4)
    pose[:3, 3] = -100
    view = pinhole_view((64, 48), 2 * np.arctan(24 / 50), pose)
    renderer = ModelRenderer(wall, viewer_frame(ViewerItem("wall", None, wall)))
    np.testing.assert_allclose(renderer.depth(view), 4, atol=0.02)
    np.testing.assert_allclose(renderer.color(view), 0.5, atol=0.03)


def test_pictures_are_split_at_the_border():
    red, blue = np.zeros((20, 40, 3), np.uint8), np.zeros((20, 40, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    split = split_picture(red, blue, at=0.25)
    assert (split[:, :9, 0] == 255).all()
    assert (split[:, 12:, 2] == 255).all()


def test_a_ply_of_points_is_shown_as_points(room):
    assert open_item(room / "sparse/0/points3D.ply").gaussians is None


def test_a_model_in_its_trainers_frame_is_shown_by_the_cameras_of_its_scene(
    room, run_folder, tmp_path
):
    gaussians, scene = read_gaussians(run_folder / "point_cloud.ply"), load_scene(room)
    transform = find_transform("gsplat", scene)
    write_gaussians(tmp_path / "model.ply", transform_gaussians(gaussians, transform))
    item = open_item(tmp_path / "model.ply", room)
    assert np.abs(item.model.means - gaussians.means).max() < 1e-4
    assert "trainer's frame (gsplat)" in str(item.findings[0])
    elsewhere = dataclasses.replace(gaussians, means=gaussians.means + np.float32(100))
    write_gaussians(tmp_path / "model.ply", elsewhere)
    item = open_item(tmp_path / "model.ply", room)
    assert np.array_equal(item.model.means, elsewhere.means)
    assert [each.kind for each in item.findings] == ["another-scene"]


def test_a_run_whose_scene_was_made_anew_since_is_noted(room, run_folder, tmp_path):
    """The poses in its place are those of another world, in which the model is not."""
    scene = load_scene(room)
    points = scene.points.replace(xyz=scene.points.xyz + np.float32(100))
    write_scene(scene.replace(points=points), tmp_path / "anew")
    run = shutil.copytree(run_folder, tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    for place, noted in ((room, False), (tmp_path / "anew", True)):
        (run / "config.json").write_text(json.dumps(config | {"scene": str(place)}))
        kinds = [each.kind for each in open_item(run).findings]
        assert ("another-scene" in kinds) == noted


# The command --------------------------------------------------------------------------------------


def _frames(path):
    """A video's frames, [F, H, W, 3], and its frames per second."""
    reader = ffmpeg.read_frames(str(path))
    facts = next(reader)
    width, height = facts["size"]
    frames = [np.frombuffer(each, np.uint8).reshape(height, width, 3) for each in reader]
    return np.stack(frames), facts["fps"]


def test_a_flight_is_a_video_of_the_scene(run_folder, tmp_path, splatseed):
    out = tmp_path / "deep/flight.mp4"
    said = splatseed("flight", run_folder, "-o", out, "--seconds", 0.2)
    assert (said.code, said.unexpected) == (0, "")
    frames, fps = _frames(out)
    assert (frames.shape, fps) == ((6, 72, 96, 3), 30)
    assert frames.mean() > 20
    assert np.abs(np.diff(frames.astype(int), axis=0)).mean() > 0.5  # it moves


def test_photographs_that_are_left_out_have_no_camera(room, run_folder):
    item, whole = open_item(run_folder, excluded=["view_001*", "view_003*"]), open_item(run_folder)
    names = [view.name for view in whole.train_views]
    kept = [name for name in names if name not in {"view_001.png", "view_003.png"}]
    assert [view.name for view in item.train_views] == kept != names
    assert [each.kind for each in item.findings] == ["excluded-photographs"]
    with pytest.raises(ParameterError, match="whose scene is not known"):
        open_item(run_folder / "point_cloud.ply", excluded=["view_001*"])


def test_without_cameras_the_video_circles_with_a_note(run_folder, tmp_path, splatseed):
    ply = shutil.copy(run_folder / "point_cloud.ply", tmp_path / "model.ply")
    words = ("flight", ply, "--seconds", 0.05, "--size", "48x32", "-o")
    assert "circles" in splatseed(*words, tmp_path / "a.mp4").err
    assert "circles" not in splatseed(*words, tmp_path / "b.mp4", "--path", "orbit").err
    assert (_frames(tmp_path / "a.mp4")[0] == _frames(tmp_path / "b.mp4")[0]).all()


def _path_in(world, camera, path):
    """Write a path as nerfstudio does: twice a camera of the scene, in another world."""
    pose = np.linalg.inv(world.camera(camera.cam_from_world)) @ np.diag([1.0, -1, -1, 1])
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.K[1, 1]))
    frames = 2 * [{"camera_to_world": pose.reshape(-1).tolist(), "fov": fov}]
    path.write_text(json.dumps({"camera_path": frames, "fps": 8}))
    return path


def test_a_path_has_a_size_of_its_own(room, run_folder, tmp_path, splatseed):
    camera = load_scene(room).images[3].camera
    path = _path_in(Similarity(1.0, np.eye(3), np.zeros(3)), camera, tmp_path / "path.json")
    content = json.loads(path.read_text()) | {"render_width": 64, "render_height": 36}
    path.write_text(json.dumps(content))
    for words, size in (((), (36, 64)), (("--size", "32x32"), (32, 32))):
        video = tmp_path / f"{len(words)}.mp4"
        said = splatseed("flight", run_folder, "--path", path, "-o", video, *words)
        assert said.code == 0, said.err
        assert _frames(video)[0].shape[1:3] == size


def _render(run_folder, image):
    gaussians = read_gaussians(run_folder / "point_cloud.ply")
    renderer = ModelRenderer(gaussians, viewer_frame(ViewerItem("", None, gaussians)))
    return renderer.color(camera_views([image])[0])


def test_a_path_through_the_models_own_world_is_moved_with_the_model(
    room, run_folder, tmp_path, splatseed
):
    """As drawn in the viewer of the model's trainer, which normalises the scene."""
    scene = load_scene(room)
    world, image = find_transform("gsplat", scene), scene.images[3]
    path = _path_in(world, image.camera, tmp_path / "path.json")
    moved = transform_gaussians(read_gaussians(run_folder / "point_cloud.ply"), world)
    write_gaussians(tmp_path / "model.ply", moved)
    video = tmp_path / "flight.mp4"
    words = ("flight", tmp_path / "model.ply", "--scene", room, "--path", path, "-o", video)
    said = splatseed(*words)
    assert said.code == 0, said.err
    assert "--transform none" in said.err
    shown = _frames(video)[0][0] / 255
    assert np.abs(shown - _render(run_folder, image)).mean() < 0.01


def test_a_path_through_nerfstudios_world_needs_its_transform(
    room, run_folder, tmp_path, splatseed
):
    """Turned, moved and scaled: as it is, it leads past the model; with the transform it does
    not."""
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    world = Similarity(0.01, turn, np.array([0.2, 40.0, 0.1]))
    rows = np.column_stack([turn, world.translation / 0.01]).tolist()
    content = {"transform": rows, "scale": 0.01}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(content))
    path = _path_in(world, load_scene(room).images[3].camera, tmp_path / "path.json")
    words = ("flight", run_folder, "-o", tmp_path / "flight.mp4", "--path", path)
    said = splatseed(*words)
    assert (said.code, "--transform" in said.err) == (2, True)
    said = splatseed(*words, "--transform", tmp_path / "dataparser_transforms.json")
    assert said.code == 0, said.err
    wanted = _render(run_folder, load_scene(room).images[3])
    shown = _frames(tmp_path / "flight.mp4")[0][0] / 255
    assert np.abs(shown - wanted).mean() < 0.01  # mirrored, it would be 0.02
    said = splatseed(*words, "--transform", "none", "--depth", "--overwrite")
    assert said.code == 0, said.err
    depth, fps = _frames(tmp_path / "flight.mp4")
    assert (len(depth), fps) == (2, 8)


def test_models_of_other_places_are_refused(run_folder, room, tmp_path, splatseed):
    scene = load_scene(room)
    moved = [dataclasses.replace(im, translation=im.translation + 1) for im in scene.images]
    write_scene(scene.replace(images=tuple(moved)), tmp_path / "elsewhere")
    other = shutil.copytree(run_folder, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    config["scene"] = str(tmp_path / "elsewhere")
    (other / "config.json").write_text(json.dumps(config))
    words = ("flight", run_folder, "--compare", other, "--seconds", 0.05, "--size", "101x75")
    heard = splatseed(*words, "-o", tmp_path / "a.mp4")
    assert (heard.code, heard.err.count("\n")) == (2, 1)
    assert "--compare" in heard.err
    heard = splatseed(*words, "-o", tmp_path / "a.mp4", "--scene", room)
    assert heard.code == 0, heard.err
    frames, _ = _frames(tmp_path / "a.mp4")
    assert frames.shape[1:] == (76, 100, 3)  # odd sizes become even
    assert (frames[:, 10:60, 49:51].mean(axis=(0, 2, 3)) > 150).all()  # the line between them
