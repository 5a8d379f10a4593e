"""The reader of RGB-D captures in TUM's and Replica's layouts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import map_coordinates

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene
from splatseed.io.depth_maps import Undistortion
from splatseed.io.rgbd import load_rgbd, load_tum
from splatseed.lens import project_rays
from splatseed.scene import SceneSource

from ..findings import texts

START, PERIOD = 1305031102.175304, 1 / 30
TIMES = START + PERIOD * np.arange(4)
CAMERA = {"w": 40, "h": 30, "fx": 35.0, "fy": 36.0, "cx": 19.5, "cy": 14.5, "scale": 1000.0}


def turn(angle):
    """The quaternion xyzw of a turn about y by ``angle`` [rad]."""
    return np.array([0, np.sin(angle / 2), 0, np.cos(angle / 2)])


def write_list(path, rows):
    np.savetxt(path, [list(map(str, row)) for row in rows], "%s", header="a comment\n")


def write_track(root, times, angles, centers):
    signs = np.resize([1, -1], len(times))  # of a quaternion, which mean the same
    known = zip(times, centers, angles, signs, strict=True)
    rows = [(repr(float(t)), *c, *(s * turn(a))) for t, c, a, s in known]
    write_list(root / "groundtruth.txt", rows)


@pytest.fixture
def capture(tmp_path):
    """Four images and their depth 5 ms later, poses 2 ms before and 8 ms after each image."""
    root = tmp_path / "rgbd_dataset_freiburg3_desk"
    for kind, late in (("rgb", 0), ("depth", 0.005)):
        (root / kind).mkdir(parents=True)
        rows = [(f"{t + late:.6f}", f"{kind}/{t + late:.6f}.png") for t in TIMES]
        write_list(root / f"{kind}.txt", rows[::-1])  # unsorted
        for i, (_, name) in enumerate(rows):
            mode, value = ("RGB", "teal") if kind == "rgb" else ("I;16", 5000 * (i + 1))
            PilImage.new(mode, (640, 480), value).save(root / name)
    write_track(
        root,
        np.stack([TIMES - 0.002, TIMES + 0.008], axis=1).ravel(),
        np.repeat(0.1 * np.arange(4), 2) + np.tile([0, 0.01], 4),
        [(i + shift, 0, -i) for i in range(4) for shift in (0, 0.1)],
    )
    return root


def test_images_poses_and_depth_belong_together_by_time(capture):
    scene = load_scene(capture, require_points=False)
    names = [f"{t:.6f}.png" for t in TIMES]
    assert [image.name for image in scene.images] == list(scene.depths) == names
    assert scene.findings == ()
    assert (scene.source.format, scene.source.image_dir) == ("rgbd", capture / "rgb")
    for i, image in enumerate(scene.images):
        assert np.unique(scene.depths.read(image.name).values) == [i + 1]
        x, y, z, w = turn(0.1 * i + 0.002)  # 2 of the 10 ms between its records
        world_from_cam = image.camera.world_from_cam
        np.testing.assert_allclose(world_from_cam[:3, 3], [i + 0.02, 0, -i], atol=1e-4)
        quat = quat_from_rotation(world_from_cam[:3, :3])
        np.testing.assert_allclose(quat, [w, x, y, z], atol=1e-5)


def test_camera_of_the_series_or_of_a_file(capture):
    lens = load_tum(capture).intrinsics[0]
    assert lens == Intrinsics(1, "PINHOLE", 640, 480, (535.4, 539.2, 320.6, 248.1))
    capture = capture.rename(capture.with_name("rgbd_dataset_freiburg2_xyz"))
    scene = load_tum(capture)
    (lens,) = scene.intrinsics
    assert (lens.model, lens.params[0], len(lens.params)) == ("FULL_OPENCV", 520.9, 12)
    assert any("distortion" in text for text in texts(scene))
    assert scene.depths.lens is None  # the photographs have the same distortion
    capture = capture.rename(capture.with_name("kitchen"))
    scene = load_tum(capture)
    assert scene.intrinsics[0].params == (525, 525, 320, 240)
    assert "focal length 525" in texts(scene)[0]
    for folder in (capture.parent, capture):
        camera = CAMERA | {"w": 640, "h": 480}
        (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
        scene = load_tum(capture)
        assert scene.intrinsics[0].params == (35, 36, 19.5, 14.5)
        assert scene.depths.scale == find_depths(scene, capture).scale == 1000
        (folder / "cam_params.json").unlink()


def test_the_folder_of_depth_images_leads_to_its_capture(capture):
    scene = load_tum(capture)
    depths = find_depths(scene, capture / "depth")
    assert depths.paths == {n: p.resolve() for n, p in scene.depths.paths.items()}
    assert depths.scale == 5000
    assert find_depths(scene, capture, scale=2000).scale == 2000
    np.save(capture / "depth" / f"{START:.6f}.npy", np.ones((3, 4)))  # the user's own go first
    assert list(find_depths(scene, capture / "depth")) == [f"{START:.6f}.png"]
    assert find_depths(scene, capture / "depth").scale is None


def test_images_without_pose_or_file_are_left_out_and_told(capture):
    write_track(capture, TIMES[:2] + 0.019, [0, 0], np.zeros((2, 3)))
    (capture / "rgb" / f"{TIMES[1]:.6f}.png").unlink()
    scene = load_tum(capture)
    assert [image.name for image in scene.images] == [f"{TIMES[i]:.6f}.png" for i in (0, 2)]
    rows = [(f"{t + 0.005:.6f}", f"depth/{t + 0.005:.6f}.png") for t in TIMES]
    write_list(capture / "depth.txt", [rows[0], (TIMES[2] + 0.0205, rows[2][1])])
    assert list(load_tum(capture).depths) == [f"{TIMES[0]:.6f}.png"]  # the other is too late
    without_pose, without_file = texts(scene)
    assert f"rgb/{TIMES[3]:.6f}" in without_pose
    assert "1 image without a file" in without_file


DISTORTED = (517.3, 516.5, 319.1, 255.8, 0.26, -0.95, -0.005, 0.003, 1.16, 0.01, -0.02, 0.03)


def test_undistorted_map_has_the_value_that_the_lens_saw_along_each_ray():
    lens = Intrinsics(1, "FULL_OPENCV", 640, 480, DISTORTED)
    camera = Intrinsics(1, "PINHOLE", 600, 440, (520.0, 515.0, 300.0, 225.0))
    row, column = np.mgrid[:480, :640].astype(np.float32)
    values = column + 1000 * row  # which pixel it is
    whole, half = (
        Undistortion({"a.png": lens}, {"a.png": camera}).apply("a.png", values[::step, ::step])
        for step in (1, 2)
    )
    assert (whole.shape, whole.dtype) == ((440, 600), np.float32)
    for u, v in [(0, 0), (300, 225), (10, 400), (599, 439), (450, 100)]:
        ray = np.array([(u + 0.5 - 300) / 520, (v + 0.5 - 225) / 515])
        x, y = np.floor(project_rays(lens, ray))
        expected = x + 1000 * y if 0 <= x < 640 and 0 <= y < 480 else np.nan
        np.testing.assert_equal(whole[v, u], np.float32(expected))
    assert half[225, 300] % 1000 // 2 == whole[225, 300] % 1000 // 2


def test_maps_are_undistorted_with_their_photographs(capture, tmp_path):
    """A scene made from a capture by undistorting has maps in its own pixels; a copy has not."""
    capture = capture.rename(capture.with_name("rgbd_dataset_freiburg1_xyz"))
    original = load_tum(capture)
    camera = Intrinsics(1, "PINHOLE", 500, 400, (520.0, 520.0, 250.0, 200.0))
    images = tuple(replace(image, intrinsics=camera) for image in original.images)
    folder = tmp_path / "scene" / "images"
    folder.mkdir(parents=True)
    for image in images:
        PilImage.new("RGB", (500, 400)).save(folder / image.name)
    source = SceneSource("colmap", folder.parent, folder, image_dir=folder)
    undistorted = original.replace(images=images, source=source)
    values = find_depths(undistorted, capture).read(images[2].name).values
    assert values.shape == (400, 500)
    assert np.nanmedian(values) == 3
    for image in images:
        (folder / image.name).write_bytes((capture / "rgb" / image.name).read_bytes())
    assert find_depths(undistorted, capture).lens is None


def pose(angle, center):
    """world_from_cam: a turn about z by ``angle`` [rad], then a move to ``center``."""
    world_from_cam = np.eye(4)
    world_from_cam[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    world_from_cam[:3, 3] = center
    return world_from_cam


POSES = [pose(0.1 * i, (i, -i, 0.5)) for i in range(3)]


def write_poses(folder, poses):
    np.savetxt(folder / "traj.txt", np.reshape(poses, (-1, 16)))


@pytest.fixture
def room(tmp_path):
    folder = tmp_path / "room"
    (folder / "results").mkdir(parents=True)
    for name in ("frame2.jpg", "frame10.jpg", "frame000001.png"):  # in their numbers' order: last
        PilImage.new("RGB", (40, 30)).save(folder / "results" / name)
    for number, value in (("000001", 500), ("02", 1000), ("11", 2000)):
        PilImage.new("I;16", (40, 30), value).save(folder / "results" / f"depth{number}.png")
    write_poses(folder, POSES)
    (folder / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    return folder


def test_frames_are_paired_with_poses_and_depth_by_number(room):
    scene = load_rgbd(room)
    names = ["frame000001.png", "frame2.jpg", "frame10.jpg"]
    assert [image.name for image in scene.images] == names
    for image, world_from_cam in zip(scene.images, POSES, strict=True):
        np.testing.assert_allclose(image.camera.world_from_cam, world_from_cam, atol=1e-12)
    assert len({image.image_id for image in scene.images}) == 3
    assert (len(scene.points), scene.findings) == (0, ())
    assert (scene.source.format, scene.source.image_dir) == ("rgbd", room / "results")
    depths = {name: np.unique(scene.depths.read(name).values).tolist() for name in scene.depths}
    assert depths == {names[0]: [0.5], names[1]: [1.0]}
    for path in (room / "results").glob("depth*.png"):
        path.unlink()
    assert load_rgbd(room).depths is None


def test_lost_frames_are_left_out_and_told(room):
    write_poses(room, [POSES[0], np.full((4, 4), np.inf), POSES[2]])
    scene = load_rgbd(room)
    assert [image.name for image in scene.images] == ["frame000001.png", "frame10.jpg"]
    np.testing.assert_allclose(scene.images[1].camera.world_from_cam, POSES[2], atol=1e-12)
    (told,) = texts(scene)
    assert "frame2.jpg" in told


def test_missing_files_frames_of_another_size_and_bad_poses_are_named(room):
    for name in ("cam_params.json", "traj.txt", "results"):
        (room / name).rename(room / "elsewhere")
        with pytest.raises(SceneNotFoundError, match=name):
            load_rgbd(room)
        (room / "elsewhere").rename(room / name)
    frame = room / "results/frame2.jpg"
    whole = frame.read_bytes()
    for write, said in (
        (PilImage.new("RGB", (20, 15)).save, r"frame2\.jpg .* found 20x15"),
        (lambda path: path.write_bytes(b"no image"), r"frame2\.jpg to be an image"),
    ):
        write(frame)
        with pytest.raises(SceneFormatError, match=said):
            load_rgbd(room)
    frame.write_bytes(whole)
    for text in (b"1 2 3\n", b"\n\n" + b"x " * 16, b"0 " * 16 + b"\n", b"", b"\xff\xfe\x00"):
        (room / "traj.txt").write_bytes(text)
        with pytest.raises(SceneFormatError, match=r"traj\.txt"):
            load_rgbd(room)
    for bad in (np.zeros(16), np.full(16, 1e308), np.diag([1, 1, -1, 1]), POSES[1].T):
        write_poses(room, [bad.reshape(4, 4)] * 3)
        with pytest.raises(SceneFormatError, match=r"traj\.txt"):
            load_rgbd(room)


def test_real_depth_agrees_best_at_the_principal_point(scenes):
    many = load_rgbd(scenes / "7scenes_redkitchen")
    assert (len(many.images), many.findings) == (143, ())
    scene = load_rgbd(scenes / "replica/room0")
    first, last = (scene.images[i].camera for i in (0, 19))
    maps = [np.asarray(scene.depths.read(scene.images[i].name).values, float) for i in (0, 19)]
    row, column = (a.ravel() for a in np.mgrid[5 : first.height : 10, 5 : first.width : 10])
    pixels = np.stack([column, row], axis=1) + 0.5

    def error(shift):
        """Median difference of depths along the same rays, the principal points being shifted."""
        uv, predicted = last.project(first.unproject(pixels - shift, maps[0][row, column]))
        measured = map_coordinates(maps[1], (uv + shift - 0.5).T[::-1], order=1, cval=np.nan)
        return float(np.nanmedian(np.abs(measured - predicted)))

    assert error(0.0) < 0.6 * min(error(-0.5), error(0.5))
    assert error(0.0) < 1e-4  # metres
