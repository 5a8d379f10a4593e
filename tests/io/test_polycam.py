"""Polycam's raw export: corrected key frames first, and what is missing is said."""

from __future__ import annotations

import shutil

import pytest
from PIL import Image

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene, write_scene

from ..findings import texts
from .phone_exports import change, check_cameras, check_depths, write_polycam


def load(path):
    return load_scene(path, require_points=False)


@pytest.fixture
def export(room_with_depth, tmp_path):
    return write_polycam(room_with_depth, tmp_path / "export")


def rename(paths, suffix):
    for path in paths:
        path.rename(path.with_suffix(suffix))


def test_hidden_files_of_macos_are_no_key_frames(export):
    for path in [each for each in export.rglob("*") if each.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"Mac OS X")
    assert (len(load(export).images), load(export).findings) == (9, ())


@pytest.mark.parametrize("prefix", ["corrected_", ""])
@pytest.mark.parametrize("given", ["", "keyframes"])
def test_cameras_depth_and_confidence_come_back(room_with_depth, tmp_path, prefix, given):
    export = write_polycam(room_with_depth, tmp_path / "export", prefix)
    scene = load(export / given)
    assert scene.findings == ()
    assert (scene.source.format, scene.source.root) == ("phone", export / given)
    assert scene.source.image_dir == export / f"keyframes/{prefix}images"
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    again = load(write_scene(scene, tmp_path / "out", require_points=False).path)
    assert find_depths(again, export / given).paths == scene.depths.paths


def test_original_key_frames_without_corrected_ones(export):
    shutil.rmtree(export / "keyframes/corrected_cameras")
    scene = load(export)
    assert scene.source.image_dir == export / "keyframes/images"
    assert scene.images[0].camera.world_from_cam[0, 3] == pytest.approx(9)


def test_key_frames_without_a_photograph_or_a_camera_are_left_out(export):
    cameras = sorted((export / "keyframes/corrected_cameras").iterdir())
    cameras[0].unlink()
    sorted((export / "keyframes/corrected_images").iterdir())[1].unlink()
    scene = load(export)
    assert [image.name for image in scene.images] == [f"{c.stem}.jpg" for c in cameras[2:]]
    assert [w for w in texts(scene) if "left out" in w] == [
        f"1 of 8 photographs has no camera and is left out, such as {cameras[0].stem}.jpg.",
        "1 of 8 cameras has no photograph and is left out.",
    ]


@pytest.mark.parametrize("originals", ["with sizes", "without", "none"])
def test_corrected_cameras_without_a_size_have_the_photographs(
    room_with_depth, tmp_path, originals
):
    """As the app exports since 2025 (nerfstudio's pull request 3725)."""
    export = write_polycam(room_with_depth, tmp_path / "export")
    for path in (export / "keyframes").glob("*cameras/*.json"):
        if path.parent.name == "corrected_cameras" or originals == "without":
            change(path, width=None, height=None)
        elif originals == "none":
            path.unlink()
    scene = load(export)
    assert scene.findings == ()
    check_cameras(scene, room_with_depth)


def test_intrinsics_without_a_size_are_those_of_the_export(export):
    """Photographs that were resized since have another size than their cameras."""
    for path in (export / "keyframes/corrected_cameras").iterdir():
        change(path, width=None, height=None)
    for path in (export / "keyframes/corrected_images").iterdir():
        Image.open(path).resize((48, 36)).save(path)
    scene = load(export)
    assert [each.kind for each in scene.findings] == ["photographs-resized"]
    assert (scene.images[0].camera.width, scene.images[0].intrinsics.width) == (48, 96)
    shutil.rmtree(export / "keyframes/cameras")
    with pytest.raises(SceneFormatError, match="a principal point near the middle of 48 x 36"):
        load(export)
    for path in (export / "keyframes/corrected_cameras").iterdir():
        change(path, cx=24.0, cy=18.0, fx=500.0)
    with pytest.raises(SceneFormatError, match="focal lengths of a phone"):
        load(export)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"t_12": None}, r"a number t_12 in .*\.json; found none\. Export"),
        ({"t_12": "0"}, r"a number t_12 in .*; found '0'"),
        ({"fx": None}, "a number fx in "),
        ({"t_00": 3.0}, "a rotation and a translation"),
        ({"width": 48.5}, "width and height in pixels in .*; found 48.5 x 72"),
        ({"cx": 1.0}, "a principal point near the middle of 96 x 72 pixels"),
        ({"fy": float("nan")}, "a finite number fy in "),
        ({"fx": 10**400}, "a finite number fx in .*found inf"),
    ],
)
def test_malformed_cameras_are_named(export, fields, words):
    for path in (export / "keyframes/corrected_cameras").iterdir():
        change(path, **fields)
    with pytest.raises(SceneFormatError, match=words):
        load(export)


def test_an_export_without_developer_mode(export):
    for name in ("cameras", "corrected_cameras", "corrected_images"):
        shutil.rmtree(export / "keyframes" / name)
    words = (
        r"found 9 photographs and 0 cameras\. In Polycam, switch Developer mode on.*sfm .*images"
    )
    for path in (export, export / "keyframes"):
        with pytest.raises(SceneNotFoundError, match=words):
            load(path)
