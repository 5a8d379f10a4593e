"""Stray Scanner's recordings: the values that went in come out, and what is missing is said."""

from __future__ import annotations

import shutil
import struct

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import MissingDependencyError, SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.recordings import FilmSettings
from splatseed.io.stray import CAMERA, ODOMETRY, VIDEO

from ..findings import texts
from .phone_exports import check_cameras, check_depths, write_stray

pytest.importorskip("imageio_ffmpeg", reason="videos need imageio-ffmpeg (extra sfm)")


def load(path):
    return load_scene(path, require_points=False)


@pytest.fixture(scope="module")
def recorded(room_with_depth, tmp_path_factory):
    return write_stray(room_with_depth, tmp_path_factory.mktemp("stray") / "2f1c")


@pytest.fixture
def recording(recorded, tmp_path, captures):
    """A recording to change."""
    return shutil.copytree(recorded, tmp_path / "2f1c")


def hide_first_frame(video):
    """Let the edit list begin at the second frame, as for a frame timed before 0."""
    data = bytearray(video.read_bytes())
    at = data.index(b"elst") + 16  # after version and count: duration, then the start
    (start,) = struct.unpack_from(">i", data, at)
    scale = struct.unpack_from(">I", data, data.index(b"mdhd") + 16)[0]
    struct.pack_into(">i", data, at, start + scale // 60)
    video.write_bytes(data)


def change_lines(recording, change):
    path = recording / ODOMETRY
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *change(lines[1:])]) + "\n")


def shown(scene, truth):
    """Which photograph of the room each image shows."""
    photographs = [np.asarray(PilImage.open(im.path).convert("RGB"), float) for im in truth.images]
    return [
        int(np.argmin([np.abs(image.read() - each).mean() for each in photographs]))
        for image in scene.images
    ]


def test_cameras_depth_and_confidence_come_back(recording, room_with_depth, captures):
    before = {path: path.stat().st_mtime_ns for path in recording.rglob("*")}
    scene = load(recording)
    assert scene.findings == ()
    assert (scene.source.format, scene.source.root) == ("phone", recording)
    assert scene.source.image_dir.parent == captures
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    assert shown(scene, room_with_depth) == [*range(9)]
    assert {path: path.stat().st_mtime_ns for path in recording.rglob("*")} == before


def test_one_camera_in_older_versions(room_with_depth, tmp_path, captures):
    recording = write_stray(room_with_depth, tmp_path / "old", lens=False)
    for path in (recording / "depth").iterdir():
        np.save(path.with_suffix(".npy"), np.array(PilImage.open(path)))
        path.unlink()
    scene = load(recording)
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    assert len(scene.intrinsics) == 1
    (recording / CAMERA).write_text("9, 0, 5\n0, 9, 4")
    with pytest.raises(SceneFormatError, match=r"camera_matrix\.csv to be fx 0 cx 0 fy cy 0 0 1"):
        load(recording)
    (recording / CAMERA).unlink()
    with pytest.raises(SceneNotFoundError, match=r"odometry\.csv, or a file .*camera_matrix"):
        load(recording)


def test_the_frame_that_players_hide_is_the_first(recording, room_with_depth):
    hide_first_frame(recording / VIDEO)
    scene = load(recording)
    assert scene.findings == ()
    assert shown(scene, room_with_depth) == [*range(9)]


def test_a_copy_without_the_hidden_frame_begins_at_the_second_pose(recording, room_with_depth):
    change_lines(recording, lambda lines: [lines[0], *map(later, lines)])
    for kind in ("depth", "confidence"):
        for i in reversed(range(9)):
            path = recording / kind / f"{i:06}.png"
            path.rename(path.with_stem(f"{i + 1:06}"))
    scene = load(recording)
    assert [image.name for image in scene.images] == [f"{i:06}.jpg" for i in range(1, 10)]
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    (note,) = texts(scene)
    assert note == "rgb.mp4 has 9 frames and odometry.csv 10 poses: the first pose has none."


def later(line):
    """The line of the next frame."""
    fields = line.split(", ")
    return ", ".join([fields[0], f"{int(fields[1]) + 1:06}", *fields[2:]])


def test_frames_after_the_last_pose_are_left_out(recording, room_with_depth):
    change_lines(recording, lambda lines: lines[:7])
    scene = load(recording)
    check_cameras(scene, room_with_depth.replace(images=room_with_depth.images[:7]))
    (note,) = texts(scene)
    assert note == "rgb.mp4 has 9 frames and odometry.csv 7 poses: the last have no pose."


def test_lost_tracking_leaves_a_frame_out(recording, room_with_depth):
    change_lines(recording, lambda lines: [*lines[:4], lost(lines[4]), *lines[5:]])
    scene = load(recording)
    kept = [image for i, image in enumerate(room_with_depth.images) if i != 4]
    check_cameras(scene, room_with_depth.replace(images=tuple(kept)))
    assert shown(scene, room_with_depth) == [0, 1, 2, 3, 5, 6, 7, 8]
    (recording / "depth/000002.png").unlink()
    (recording / "confidence/000003.png").unlink()
    scene = load(recording)
    assert "000002.jpg" not in scene.depths
    assert scene.depths.read("000003.jpg").confidence is None


def lost(line):
    fields = line.split(", ")
    return ", ".join([*fields[:2], *["nan"] * 7, *fields[9:]])


def test_few_frames_of_many_and_extracted_once(recording, captures, monkeypatch):
    monkeypatch.setattr("splatseed.io.stray.FILM", FilmSettings(max_frames=4))
    scene = load(recording)
    assert 3 <= len(scene.images) <= 4
    (note,) = texts(scene)
    assert note.startswith(f"{len(scene.images)} of the 9 frames of rgb.mp4 are used: the sharpest")
    (folder,) = captures.iterdir()
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*")}
    assert [image.name for image in load(recording).images] == [i.name for i in scene.images]
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*")} == before


def test_what_cannot_be_used_is_one_error(recording, captures, monkeypatch):
    text, video = (recording / ODOMETRY).read_text(), (recording / VIDEO).read_bytes()
    first = text.splitlines()[0]
    for changed, match in (
        (first, "found only a first line"),
        ("", "found an empty file"),
        (text.replace("qw", "w"), r"x, y, z, qx, qy, qz, qw in .*found no qw"),
        (text.replace(" 000003,", " three,"), r"numbers, separated by commas, in .*line 5"),
        (text + "7, 8\n", r"line 11; found 7, 8"),
        (text.replace(" 000003,", " 000009,"), "rising frame numbers"),
        (text.replace(" 000008,", " 000008, 1, 2, 3, 4, 5, 6, 7,"), r"qx qy qz qw of length 1.*10"),
        (text + "".join(text.splitlines(keepends=True)[1:]).replace(" 00000", " 0001"),
         r"rgb\.mp4 to have the 18 frames of odometry\.csv; found 9"),
    ):  # fmt: skip
        (recording / ODOMETRY).write_text(changed)
        with pytest.raises(SceneFormatError, match=match):
            load(recording)
    (recording / ODOMETRY).write_text(text)
    (recording / VIDEO).write_bytes(video[:3000])
    with pytest.raises(SceneFormatError, match="a video that ffmpeg can read"):
        load(recording)
    (recording / VIDEO).write_bytes(video)
    with monkeypatch.context() as missing:
        missing.setattr("splatseed.requirements.find_spec", lambda _: None)
        with pytest.raises(MissingDependencyError, match="imageio_ffmpeg"):
            load(recording)
    assert not [path for path in captures.iterdir() if "partial" in path.name]
    with pytest.raises(SceneFormatError, match=r"Pass the scene's folder: .*2f1c$"):
        load(recording / VIDEO)
    (recording / VIDEO).unlink()
    with pytest.raises(SceneNotFoundError, match=r"rgb\.mp4, with the photographs"):
        load(recording)
