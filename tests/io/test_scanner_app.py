"""3D Scanner App's export: the values that went in come out, and what is missing is said."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.load import with_depths_in, with_own_depths
from splatseed.scene import SceneSource
from splatseed.sfm.photos import find_photos

from ..findings import texts
from .phone_exports import change, check_cameras, check_depths, write_scanner_app


def load(path):
    return load_scene(path, require_points=False)


@pytest.fixture
def export(room_with_depth, tmp_path):
    return write_scanner_app(room_with_depth, tmp_path / "export")


def test_cameras_depth_and_confidence_come_back(export, room_with_depth):
    scene = load(export)
    assert scene.findings == ()
    assert (scene.source.format, scene.source.image_dir, len(scene.points)) == ("phone", export, 0)
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    assert list(find_photos(export)[0]) == [image.name for image in scene.images]


def test_a_scene_written_elsewhere_finds_the_same_maps(export, tmp_path):
    scene = load(export)
    again = load(write_scene(scene, tmp_path / "out", require_points=False).path)
    assert again.source.format == "colmap"
    assert with_own_depths(again).depths is None
    maps = find_depths(again, export)
    assert (maps.paths, maps.confidences) == (scene.depths.paths, scene.depths.confidences)
    assert len(maps.confidences) == len(scene.images)
    assert not maps.in_scene_units  # the other scene may have another unit


def test_maps_of_the_capture_named_again_keep_its_unit(export, monkeypatch):
    scene = load(export)
    assert scene.depths.in_scene_units
    monkeypatch.chdir(export.parent)
    assert find_depths(scene, export.name).in_scene_units
    assert not find_depths(scene, export.name, scale=100).in_scene_units


def test_depth_named_as_frames(export):
    """Some versions of the app write EXR files named as the photographs are."""
    for path in export.glob("depth_*.png"):
        metres = np.asarray(PilImage.open(path)) / np.float32(1000)
        np.save(path.with_name(f"frame_{path.stem[-5:]}.npy"), metres)
        path.unlink()
    depths = load(export).depths
    assert {path.suffix for path in depths.paths.values()} == {".npy"}
    assert len(depths.confidences) == 9
    assert depths.read("frame_00006.jpg").confidence.max() == 2


def test_frames_without_a_photograph_or_a_pose_are_left_out(export):
    (export / "frame_00003.jpg").unlink()
    (export / "frame_00006.jpg").unlink()
    (export / "frame_00009.json").unlink()
    (export / "conf_00012.png").unlink()
    (export / "depth_00015.png").unlink()
    scene = load(export)
    numbers = [0, 12, 15, 18, 21, 24]
    assert [image.name for image in scene.images] == [f"frame_{i:05d}.jpg" for i in numbers]
    assert [w for w in texts(scene) if "left out" in w] == [
        "2 of 8 frames have no photograph and are left out.",
        "1 photograph without a pose (a .json beside it) is left out, such as frame_00009.jpg.",
    ]
    severities = {each.severity for each in scene.findings if "have no photograph" in each.text}
    assert severities == {"info"}
    assert scene.depths.read("frame_00012.jpg").confidence is None
    assert "frame_00015.jpg" not in scene.depths


def test_a_map_without_its_confidence_is_named(export, tmp_path):
    assert with_depths_in(load(export), export).findings == ()
    (export / "conf_00006.png").unlink()
    (export / "conf_00012.png").unlink()
    scene = load(export)
    which = "frame_00006.jpg, frame_00012.jpg"
    note = f"2 of 9 depth maps have no confidence and are used whole: {which}."
    assert texts(scene) == texts(with_depths_in(scene, export)) == (note,)
    again = load(write_scene(scene, tmp_path / "out", require_points=False).path)
    assert again.findings == ()
    assert texts(with_depths_in(again, export)) == (note,)
    for path in export.glob("conf_*.png"):
        path.unlink()  # then confidence is unknown to the whole capture
    assert load(export).findings == with_depths_in(scene, export).findings == ()


def test_lost_tracking_leaves_an_image_out(export):
    change(export / "frame_00006.json", cameraPoseARFrame=[float("nan")] * 16)
    scene = load(export)
    assert scene.absent == ("frame_00006.jpg",)
    assert "1 of 9 images is left out (frame_00006.jpg)" in texts(scene)[0]


def test_cameras_of_resized_photographs_belong_to_the_captured_size(export, room_with_depth):
    for path in export.glob("frame_*.jpg"):
        PilImage.open(path).resize((48, 36)).save(path)
    scene = load(export)
    check_cameras(scene.replace(source=SceneSource()), room_with_depth)  # as recorded
    assert {(im.camera.width, im.camera.height) for im in scene.images} == {(48, 36)}
    (warning,) = texts(scene)
    assert warning.startswith("frame_00000.jpg has 48 x 36 pixels, its camera 1 96 x 72;")
    change(export / "frame_00000.json", projectionMatrix=None)  # then only K's plausibility is left
    with pytest.raises(SceneFormatError, match=r"middle of 48 x 36 pixels in .*00000\.json"):
        load(export)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"cameraPoseARFrame": None},
            "4 x 4 numbers cameraPoseARFrame in .*00003.json; found none",
        ),
        ({"cameraPoseARFrame": [1.0] * 12}, "4 x 4 numbers cameraPoseARFrame .* found 12 numbers"),
        ({"cameraPoseARFrame": ["a"] * 16}, "4 x 4 numbers cameraPoseARFrame"),
        ({"cameraPoseARFrame": [2.0, *[0.0] * 15]}, "a rotation and a translation"),
        ({"intrinsics": [80, 0, 0, 0, 80, 0, 48, 36, 1]}, "fx 0 cx 0 fy cy 0 0 1, row by row"),
        ({"intrinsics": [1e300, 0, 48, 0, 1e300, 36, 0, 0, 1]}, "a camera size in pixels"),
        ({"intrinsics": [80, 0, 48, 0, -80, 36, 0, 0, 1]}, "focal length"),
    ],
)
def test_malformed_records_are_named(export, fields, words):
    for path in export.glob("frame_*.json"):
        if path.name != "frame_00000.json":
            change(path, **fields)
    with pytest.raises(SceneFormatError, match=words):
        load(export)


def test_an_export_without_photographs_says_how_to_export(export):
    for path in export.glob("*.jpg"):
        path.unlink()
    with pytest.raises(SceneNotFoundError, match=r"frame_00000\.jpg; found none.*All Data"):
        load(export)


def test_a_confidence_map_of_another_size_or_kind(export):
    path = export / "conf_00000.png"
    PilImage.new("L", (10, 8)).save(path)
    depths = load(export).depths
    with pytest.raises(SceneFormatError, match=r"conf_00000\.png .* 48 x 36; found 10 x 8"):
        depths.read("frame_00000.jpg")
    PilImage.new("I;16", (48, 36)).save(path)
    with pytest.raises(SceneFormatError, match=r"a confidence map; found .*uint16"):
        depths.read("frame_00000.jpg")


def test_other_formats_in_the_folder_go_first(export, room_path):
    (export / "sparse").symlink_to(room_path / "sparse", target_is_directory=True)
    assert load(export).source.format == "colmap"


def test_a_real_export(scenes):
    """Surfaces of confident depth are where the next photographs' depth has them."""
    root = scenes / "corridor"
    if not root.is_dir():
        pytest.skip(f"no {root}")
    scene = load(root)
    assert (len(scene.images), len(scene.depths), scene.findings) == (146, 146, ())
    differences = []
    for first, second in zip(scene.images[::29], scene.images[2::29], strict=False):
        near, far = (scene.depths.read(image.name) for image in (first, second))
        camera, other = near.camera(first.camera), far.camera(second.camera)
        row, column = np.nonzero(near.confidence == 2)
        ray = np.stack([column + 0.5, row + 0.5, np.ones(len(row))])
        rays = np.linalg.inv(camera.K) @ ray * near.values[row, column]
        world = camera.world_from_cam[:3] @ np.vstack([rays, np.ones(len(row))])
        seen = other.K @ other.cam_from_world[:3] @ np.vstack([world, np.ones(len(row))])
        x, y = np.floor(seen[:2] / seen[2]).astype(int)
        inside = (seen[2] > 0) & (x >= 0) & (x < far.width) & (y >= 0) & (y < far.height)
        assert inside.mean() > 0.3
        differences.append(np.abs(far.values[y[inside], x[inside]] / seen[2, inside] - 1))
    assert np.median(np.concatenate(differences)) < 0.01
