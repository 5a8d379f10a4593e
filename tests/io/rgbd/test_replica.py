"""The reader of RGB-D captures in NICE-SLAM's layout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import map_coordinates

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.rgbd.replica import load_rgbd

CAMERA = {"w": 40, "h": 30, "fx": 35.0, "fy": 36.0, "cx": 19.5, "cy": 14.5, "scale": 1000.0}


def pose(angle: float, center: tuple[float, float, float]) -> np.ndarray:
    """world_from_cam: a turn about z by ``angle`` [rad], then a move to ``center``."""
    world_from_cam = np.eye(4)
    world_from_cam[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    world_from_cam[:3, 3] = center
    return world_from_cam


POSES = [pose(0.1 * i, (i, -i, 0.5)) for i in range(3)]


def write_poses(folder: Path, poses: list[np.ndarray]) -> None:
    lines = (" ".join(repr(float(value)) for value in one.ravel()) for one in poses)
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    folder = tmp_path / "room"
    (folder / "results").mkdir(parents=True)
    for name in ("frame2.jpg", "frame10.jpg", "frame000001.png"):  # in their numbers' order: last
        PilImage.new("RGB", (40, 30)).save(folder / "results" / name)
    PilImage.new("I;16", (40, 30)).save(folder / "results" / "depth000001.png")
    write_poses(folder, POSES)
    (folder / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    return folder


def test_frames_are_paired_with_poses_by_number(capture: Path) -> None:
    scene = load_rgbd(capture)
    assert [image.name for image in scene.images] == [
        "frame000001.png",
        "frame2.jpg",
        "frame10.jpg",
    ]
    for image, world_from_cam in zip(scene.images, POSES, strict=True):
        np.testing.assert_allclose(image.camera.world_from_cam, world_from_cam, atol=1e-12)
    assert len({image.image_id for image in scene.images}) == 3
    assert len(scene.points) == 0
    assert scene.source is not None
    assert scene.source.format == "rgbd"
    assert scene.source.image_dir == capture / "results"
    assert scene.warnings == ()


def test_the_principal_point_counts_from_the_corner(capture: Path) -> None:
    camera = load_rgbd(capture).images[0].camera
    uv, _ = camera.project(camera.world_from_cam[:3, 2:3].T + camera.center)
    np.testing.assert_allclose(uv, [[19.5, 14.5]], atol=1e-9)
    assert (camera.width, camera.height) == (40, 30)
    assert camera.K[0, 0] == 35.0
    assert camera.K[1, 1] == 36.0


def test_camera_file_may_lie_one_folder_up(capture: Path) -> None:
    (capture / "cam_params.json").rename(capture.parent / "cam_params.json")
    assert len(load_rgbd(capture).images) == 3


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_lost_frames_are_left_out_and_told(capture: Path, value: float) -> None:
    lost = POSES[1].copy()
    lost[0, 3] = value
    write_poses(capture, [POSES[0], lost, POSES[2]])
    scene = load_rgbd(capture)
    assert [image.name for image in scene.images] == ["frame000001.png", "frame10.jpg"]
    np.testing.assert_allclose(scene.images[1].camera.world_from_cam, POSES[2], atol=1e-12)
    assert len(scene.warnings) == 1
    assert "frame2.jpg" in scene.warnings[0]


def test_missing_files(capture: Path) -> None:
    for name in ("cam_params.json", "traj.txt", "results"):
        (capture / name).rename(capture / "elsewhere")
        with pytest.raises(SceneNotFoundError, match=name):
            load_rgbd(capture)
        (capture / "elsewhere").rename(capture / name)


def test_depth_of_the_frames_comes_along(capture: Path) -> None:
    for number, value in (("000001", 500), ("02", 1000), ("11", 2000)):
        picture = PilImage.new("I;16", (40, 30), value)
        picture.save(capture / "results" / f"depth{number}.png")
    depths = load_rgbd(capture).depths
    assert depths is not None
    assert list(depths) == ["frame000001.png", "frame2.jpg"]
    assert np.unique(depths.read("frame000001.png").values).tolist() == [0.5]
    assert np.unique(depths.read("frame2.jpg").values).tolist() == [1.0]
    for path in (capture / "results").glob("depth*.png"):
        path.unlink()
    assert load_rgbd(capture).depths is None


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("1 2 3\n", "line 1; found 3 numbers"),
        ("\n\n" + "x " * 16, "line 3; found could not convert"),
        ("0 " * 16 + "\n", "found 1 lines"),
        (("0 " * 16 + "\n") * 3, "pose 1 of .* to be a rotation"),
        (("1e308 " * 16 + "\n") * 3, "pose 1 of .* to be a rotation"),
        ("", "found 0 lines"),
        ("\N{SNOWMAN}", "line 1"),
    ],
)
def test_bad_trajectories(capture: Path, text: str, told: str) -> None:
    (capture / "traj.txt").write_text(text)
    with pytest.raises(SceneFormatError, match=told):
        load_rgbd(capture)


def test_binary_trajectory(capture: Path) -> None:
    (capture / "traj.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SceneFormatError, match="readable text file"):
        load_rgbd(capture)


def test_mirrored_pose_is_refused(capture: Path) -> None:
    mirrored = POSES[2] @ np.diag([1.0, 1.0, -1.0, 1.0])
    write_poses(capture, [POSES[0], POSES[1], mirrored])
    with pytest.raises(SceneFormatError, match="pose 3 of"):
        load_rgbd(capture)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"camera": 3}',
        '{"camera": {"w": 40}}',
        json.dumps({"camera": CAMERA | {"fx": "wide"}}),
        json.dumps({"camera": CAMERA | {"fx": 0}}),
        json.dumps({"camera": CAMERA | {"w": float("inf")}}),
        json.dumps({"camera": CAMERA | {"cx": float("nan")}}),
        json.dumps({"camera": CAMERA | {"scale": 0}}),
    ],
)
def test_bad_camera_files(capture: Path, text: str) -> None:
    (capture / "cam_params.json").write_text(text)
    with pytest.raises(SceneFormatError, match=r"cam_params\.json"):
        load_rgbd(capture)


def test_images_must_fit_the_camera(capture: Path) -> None:
    PilImage.new("RGB", (20, 15)).save(capture / "results" / "frame2.jpg")
    with pytest.raises(SceneFormatError, match=r"frame2\.jpg .* found 20x15"):
        load_rgbd(capture)
    (capture / "results" / "frame2.jpg").write_bytes(b"no image")
    with pytest.raises(SceneFormatError, match=r"frame2\.jpg to be a readable image"):
        load_rgbd(capture)


@pytest.mark.parametrize(
    ("name", "frames", "scale"), [("replica/room0", 20, 6553.5), ("7scenes_redkitchen", 143, 1e3)]
)
def test_depth_of_one_real_frame_agrees_with_the_next(
    scenes: Path, name: str, frames: int, scale: float
) -> None:
    """Points unprojected from one frame's depth meet the other's: poses and axes are right."""
    scene = load_rgbd(scenes / name)
    assert len(scene.images) == frames
    assert scene.warnings == ()
    first, second = scene.images[0].camera, scene.images[1].camera

    def depth_of(number: int) -> np.ndarray:
        with PilImage.open(scenes / name / "results" / f"depth{number:06d}.png") as image:
            return np.asarray(image) / scale

    row, column = (a.ravel() for a in np.mgrid[5 : first.height : 20, 5 : first.width : 20])
    depth = depth_of(0)[row, column]
    pixels = np.stack([column, row], axis=1)[depth > 0] + 0.5
    uv, predicted = second.project(first.unproject(pixels, depth[depth > 0]))
    inside = (uv > 0).all(axis=1) & (uv < [second.width, second.height]).all(axis=1)
    column, row = uv[inside].astype(int).T
    measured = depth_of(1)[row, column]
    error = np.abs(measured - predicted[inside])[measured > 0]
    assert len(error) > 300
    assert np.median(error) < 0.02  # metres


def test_real_depth_agrees_best_at_the_principal_point(scenes: Path) -> None:
    scene = load_rgbd(scenes / "replica/room0")
    first, last = (scene.images[i].camera for i in (0, 19))
    maps = [np.asarray(scene.depths.read(scene.images[i].name).values, float) for i in (0, 19)]
    row, column = (a.ravel() for a in np.mgrid[5 : first.height : 10, 5 : first.width : 10])
    pixels = np.stack([column, row], axis=1) + 0.5

    def error(shift: float) -> float:
        """Median difference of depths along the same rays, the principal points being shifted."""
        uv, predicted = last.project(first.unproject(pixels - shift, maps[0][row, column]))
        measured = map_coordinates(maps[1], (uv + shift - 0.5).T[::-1], order=1, cval=np.nan)
        return float(np.nanmedian(np.abs(measured - predicted)))

    assert error(0.0) < 0.6 * min(error(-0.5), error(0.5))
    assert error(0.0) < 1e-4  # metres
