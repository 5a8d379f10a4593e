"""The reader of RGB-D captures in TUM's layout."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene
from splatseed.io.depth.lens import Undistortion
from splatseed.io.rgbd.replica import load_rgbd
from splatseed.io.rgbd.tum import load_tum
from splatseed.lens import image_points
from splatseed.scene import SceneSource

START = 1305031102.175304
PERIOD = 1 / 30


def turn(angle: float) -> np.ndarray:
    """The quaternion xyzw of a turn about y by ``angle`` [rad]."""
    return np.array([0, np.sin(angle / 2), 0, np.cos(angle / 2)])


def write_list(path: Path, rows) -> None:
    lines = ["# a comment", "", *(" ".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def write_track(root: Path, times, angles, centers) -> None:
    rows = [(repr(float(t)), *c, *turn(a)) for t, a, c in zip(times, angles, centers, strict=True)]
    write_list(root / "groundtruth.txt", rows)


@pytest.fixture
def capture(tmp_path) -> Path:
    """Four images and their depth 5 ms later, poses 2 ms before and 8 ms after each image."""
    root = tmp_path / "rgbd_dataset_freiburg3_desk"
    times = START + PERIOD * np.arange(4)
    for kind, late in (("rgb", 0), ("depth", 0.005)):
        (root / kind).mkdir(parents=True)
        rows = [(f"{t + late:.6f}", f"{kind}/{t + late:.6f}.png") for t in times]
        write_list(root / f"{kind}.txt", rows[::-1])  # unsorted
        for i, (_, name) in enumerate(rows):
            mode, value = ("RGB", "teal") if kind == "rgb" else ("I;16", 5000 * (i + 1))
            PilImage.new(mode, (640, 480), value).save(root / name)
    write_track(
        root,
        np.stack([times - 0.002, times + 0.008], axis=1).ravel(),
        np.repeat(0.1 * np.arange(4), 2) + np.tile([0, 0.01], 4),
        [(i + shift, 0, -i) for i in range(4) for shift in (0, 0.1)],
    )
    return root


def test_images_poses_and_depth_belong_together_by_time(capture):
    scene = load_scene(capture, require_points=False)
    names = [f"{START + PERIOD * i:.6f}.png" for i in range(4)]
    assert [image.name for image in scene.images] == names
    assert list(scene.depths) == names
    assert scene.warnings == ()
    assert scene.source.format == "rgbd"
    assert scene.source.image_dir == capture / "rgb"
    for i, image in enumerate(scene.images):
        assert np.unique(scene.depths.read(image.name).values) == [i + 1]
        x, y, z, w = turn(0.1 * i + 0.002)  # 2 of the 10 ms between its records
        world_from_cam = image.camera.world_from_cam
        np.testing.assert_allclose(world_from_cam[:3, 3], [i + 0.02, 0, -i], atol=1e-4)
        quat = quat_from_rotation(world_from_cam[:3, :3])
        np.testing.assert_allclose(quat, [w, x, y, z], atol=1e-5)


def test_camera_of_the_series(capture):
    lens = load_tum(capture).intrinsics[0]
    assert lens == Intrinsics(1, "PINHOLE", 640, 480, (535.4, 539.2, 320.6, 248.1))
    for series, focal in ("1", 517.3), ("2", 520.9):
        capture = capture.rename(capture.with_name(f"rgbd_dataset_freiburg{series}_xyz"))
        scene = load_tum(capture)
        assert scene.intrinsics[0].model == "FULL_OPENCV"
        assert scene.intrinsics[0].params[0] == focal
        assert len(scene.intrinsics[0].params) == 12
        assert any("distortion" in text for text in scene.warnings)
        assert scene.depths.lens is None  # the photographs have the same distortion
    scene = load_tum(capture.rename(capture.with_name("kitchen")))
    assert scene.intrinsics[0].params == (525, 525, 320, 240)
    assert "focal length 525" in scene.warnings[0]


@pytest.mark.parametrize("name", ["afr1", "freiburg12", "france1", "freiburg"])
def test_no_series_in_the_name(capture, name):
    assert load_tum(capture.rename(capture.with_name(name))).intrinsics[0].params[0] == 525


def test_the_folder_of_depth_images_leads_to_its_capture(capture):
    scene = load_tum(capture)
    depths = find_depths(scene, capture / "depth")
    assert depths.paths == {n: p.resolve() for n, p in scene.depths.paths.items()}
    assert depths.scale == 5000
    np.save(capture / "depth" / f"{START:.6f}.npy", np.ones((3, 4)))  # the user's own go first
    assert list(find_depths(scene, capture / "depth")) == [f"{START:.6f}.png"]
    assert find_depths(scene, capture / "depth").scale is None


@pytest.mark.parametrize("where", [".", ".."])
def test_camera_file_goes_first(capture, where):
    camera = {"w": 640, "h": 480, "fx": 500, "fy": 510, "cx": 319.5, "cy": 239.5, "scale": 1000}
    (capture / where / "cam_params.json").write_text(json.dumps({"camera": camera}))
    scene = load_tum(capture)
    assert scene.intrinsics[0].params == (500, 510, 319.5, 239.5)
    assert scene.depths.scale == 1000
    assert find_depths(scene, capture).scale == 1000
    assert find_depths(scene, capture, scale=2000).scale == 2000


def test_images_without_pose_or_file_are_left_out_and_told(capture):
    times = START + PERIOD * np.arange(4)
    write_track(capture, times[:2] + 0.019, [0, 0], np.zeros((2, 3)))
    (capture / "rgb" / f"{times[1]:.6f}.png").unlink()
    scene = load_tum(capture)
    assert [image.name for image in scene.images] == [f"{times[0]:.6f}.png", f"{times[2]:.6f}.png"]
    assert len(scene.warnings) == 2
    assert (
        f"1 image without a pose close in time is left out, the first is rgb/{times[3]:.6f}"
        in (scene.warnings[0])
    )
    assert "1 image without a file is left out" in scene.warnings[1]


def test_far_records_are_not_interpolated(capture):
    times = START + PERIOD * np.arange(4)
    write_track(capture, [times[0] + 0.011, times[1] + 0.019], [0, 1], [(0, 0, 0), (1, 1, 1)])
    images = load_tum(capture).images  # 0 before the first; 1 between, but 41 ms apart; 2 after
    centers = [image.camera.center for image in images]
    np.testing.assert_allclose(centers, [[0, 0, 0], [1, 1, 1], [1, 1, 1]], atol=1e-12)


def test_opposite_signs_of_a_quaternion_are_the_same_rotation(capture):
    x, y, z, w = turn(0.3)
    rows = [
        (repr(START - 0.004), 0, 0, 0, x, y, z, w),
        (repr(START + 0.004), 0, 0, 0, -x, -y, -z, -w),
    ]
    write_list(capture / "groundtruth.txt", rows)
    quat = load_tum(capture).images[0].quat
    np.testing.assert_allclose(np.abs(quat @ [w, -x, -y, -z]), 1, atol=1e-12)


def test_lost_poses_are_skipped(capture):
    text = (capture / "groundtruth.txt").read_text()
    nowhere = f"{START!r} nan nan nan 0 0 0 1\n{START!r} 0 0 0 nan nan nan nan\n"
    (capture / "groundtruth.txt").write_text(text + nowhere)
    assert len(load_tum(capture).images) == 4


def test_one_pose_is_enough(capture):
    write_track(capture, [START], [0], [(1, 2, 3)])
    (image,) = load_tum(capture).images
    np.testing.assert_allclose(image.camera.center, [1, 2, 3])


def test_depth_too_late_is_none(capture):
    times = START + PERIOD * np.arange(4)
    rows = [(f"{t + 0.005:.6f}", f"depth/{t + 0.005:.6f}.png") for t in times]
    write_list(capture / "depth.txt", [rows[0], (times[2] + 0.0205, rows[2][1])])
    scene = load_tum(capture)
    assert len(scene.images) == 4
    assert list(scene.depths) == [f"{times[0]:.6f}.png", f"{times[3]:.6f}.png"]


def test_capture_without_depth(capture):
    (capture / "depth.txt").unlink()
    scene = load_tum(capture)
    assert len(scene.images) == 4
    assert scene.depths is None


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("rgb.txt", "1.0 a.png b.png\n", "2 words in .*line 1; found 3"),
        ("rgb.txt", "# x\n\nnow a.png\n", "numbers in .*line 3"),
        ("rgb.txt", "1.0 ../a.png\n", "inside the folder"),
        ("rgb.txt", "1.0 /a.png\n", "inside the folder"),
        ("rgb.txt", "nan a.png\n", "line 1"),
        ("depth.txt", "1.0\n", "depth.txt line 1"),
        ("groundtruth.txt", "1 2 3\n", "8 words"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 2\n", "quaternion of length 1"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 0\n", "quaternion of length 1"),
        ("groundtruth.txt", "1 0 0 0 0 0 0 one\n", "could not convert"),
    ],
)
def test_bad_lists(capture, name, text, told):
    (capture / name).write_text(text)
    with pytest.raises(SceneFormatError, match=told):
        load_tum(capture)


def test_lists_that_are_no_text(capture):
    (capture / "rgb.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneFormatError, match="readable text file"):
        load_tum(capture)


@pytest.mark.parametrize("name", ["rgb.txt", "groundtruth.txt"])
def test_nothing_to_load(capture, name):
    (capture / name).write_text("# nothing\n")
    with pytest.raises(SceneNotFoundError, match="with a pose"):
        load_tum(capture)
    (capture / name).unlink()
    with pytest.raises(SceneNotFoundError, match=name):
        load_tum(capture)


def test_images_must_fit_the_camera(capture):
    PilImage.new("RGB", (320, 240)).save(capture / "rgb" / f"{START:.6f}.png")
    with pytest.raises(SceneFormatError, match="640x480; found 320x240"):
        load_tum(capture)


LENS = Intrinsics(
    1,
    "FULL_OPENCV",
    640,
    480,
    (517.3, 516.5, 319.1, 255.8, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0.01, -0.02, 0.03),
)


def test_undistorted_map_has_the_value_that_the_lens_saw_along_each_ray():
    camera = Intrinsics(1, "PINHOLE", 600, 440, (520.0, 515.0, 300.0, 225.0))
    row, column = np.mgrid[:480, :640].astype(np.float32)
    values = column + 1000 * row  # which pixel it is
    undistorted = Undistortion(LENS, {"a.png": camera}).apply("a.png", values)
    assert undistorted.shape == (440, 600)
    assert undistorted.dtype == np.float32
    for u, v in [(0, 0), (300, 225), (10, 400), (599, 439), (450, 100)]:
        ray = np.array([(u + 0.5 - 300) / 520, (v + 0.5 - 225) / 515])
        x, y = np.floor(image_points(LENS, ray))
        expected = x + 1000 * y if 0 <= x < 640 and 0 <= y < 480 else np.nan
        np.testing.assert_equal(undistorted[v, u], np.float32(expected))
    half = Undistortion(LENS, {"a.png": camera}).apply("a.png", values[::2, ::2])
    np.testing.assert_array_equal(half[225, 300] % 1000 // 2, undistorted[225, 300] % 1000 // 2)


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
    maps = find_depths(undistorted, capture)
    assert maps.read(images[2].name).values.shape == (400, 500)
    assert np.nanmedian(maps.read(images[2].name).values) == 3
    for image in images:
        (folder / image.name).write_bytes((capture / "rgb" / image.name).read_bytes())
    assert find_depths(undistorted, capture).lens is None


@pytest.fixture(scope="module")
def replica_as_tum(scenes, tmp_path_factory) -> Path:
    """The real frames of Replica's room in TUM's layout."""
    room = load_rgbd(scenes / "replica/room0")
    root = tmp_path_factory.mktemp("tum") / "room"
    (root / "rgb").mkdir(parents=True)
    (root / "depth").mkdir()
    rows = {"rgb": [], "depth": [], "groundtruth": []}
    for i, image in enumerate(room.images[:3]):
        time = 100 + i / 10
        name = f"{time:.6f}"
        (root / "rgb" / f"{name}.jpg").symlink_to(room.source.image_dir / image.name)
        metres = np.nan_to_num(room.depths.read(image.name).values)
        PilImage.fromarray(np.round(5000 * metres).astype(np.uint16)).save(
            root / f"depth/{name}.png"
        )
        w, x, y, z = image.quat * [1, -1, -1, -1]
        rows["rgb"].append((name, f"rgb/{name}.jpg"))
        rows["depth"].append((name, f"depth/{name}.png"))
        rows["groundtruth"].append((name, *image.camera.center, x, y, z, w))
    for name, records in rows.items():
        write_list(root / f"{name}.txt", records)
    camera = json.loads((scenes / "replica/cam_params.json").read_text())
    del camera["camera"]["scale"]
    (root / "cam_params.json").write_text(json.dumps(camera))
    return root


def test_real_frames_are_the_same_in_both_layouts(replica_as_tum, scenes):
    expected, as_tum = load_rgbd(scenes / "replica/room0"), load_tum(replica_as_tum)
    assert len(as_tum.images) == 3
    for theirs, ours in zip(expected.images, as_tum.images, strict=False):
        np.testing.assert_allclose(ours.camera.K, theirs.camera.K)
        np.testing.assert_allclose(
            ours.camera.cam_from_world, theirs.camera.cam_from_world, atol=1e-9
        )
        maps = expected.depths.read(theirs.name), as_tum.depths.read(ours.name)
        np.testing.assert_allclose(maps[1].values, maps[0].values, atol=1.1e-4)
