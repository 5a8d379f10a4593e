"""Record3D's exports: the values that went in come out, and what is missing is said."""

from __future__ import annotations

import json
import sys
import zipfile
from dataclasses import replace
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.recordings import FilmSettings

from ..findings import texts
from .phone_exports import change, check_cameras, check_depths, write_r3d, write_record3d


def load(path):
    return load_scene(path, require_points=False)


@pytest.fixture
def export(room_with_depth, tmp_path):
    return write_record3d(room_with_depth, tmp_path / "export")


@pytest.fixture
def lzfse(monkeypatch):
    """The package that decompresses depth, or one that reads blocks that are not compressed."""
    if find_spec("lzfse") is None:
        module = ModuleType("lzfse")
        module.__spec__ = ModuleSpec("lzfse", None)
        module.decompress = lambda data: data[8 : 8 + int.from_bytes(data[4:8], "little")]
        monkeypatch.setitem(sys.modules, "lzfse", module)


@pytest.fixture
def no_lzfse(monkeypatch):
    monkeypatch.setattr("splatseed.requirements.find_spec", lambda name: name != "lzfse" or None)


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_cameras_and_depth_come_back(export, room_with_depth):
    before = contents(export)
    scene, inside = load(export), load(export / "EXR_RGBD")
    assert scene.findings == ()
    root = export / "EXR_RGBD"
    assert (scene.source.format, scene.source.root, scene.source.image_dir) == (
        "phone",
        root,
        root / "rgb",
    )
    check_cameras(scene, room_with_depth)
    check_cameras(inside, room_with_depth)
    assert contents(export) == before
    pytest.importorskip("OpenEXR")
    for image, known in zip(scene.images, room_with_depth.images, strict=True):
        depth = scene.depths.read(image.name).values
        np.testing.assert_array_equal(
            depth, room_with_depth.depths.read(known.name).values[::2, ::2]
        )


def test_without_openexr_poses_are_read_and_maps_left_out(export, monkeypatch):
    pytest.importorskip("OpenEXR")
    monkeypatch.setattr("splatseed.requirements.find_spec", lambda _: None)
    scene = load(export)
    assert (len(scene.images), scene.depths) == (9, None)
    (note,) = texts(scene)
    assert note.startswith("Depth maps are left out, as reading them needs OpenEXR. Install it")


def test_a_photograph_has_the_pose_of_its_number(room_with_depth, tmp_path):
    """The app drops photographs but keeps their poses; 2.jpg is before 10.jpg."""
    export = write_record3d(room_with_depth, tmp_path / "export", step=2)
    rgb = export / "EXR_RGBD/rgb"
    (rgb / "16.jpg").rename(rgb / "19.jpg")
    scene = load(export)
    assert [image.name for image in scene.images] == [f"{2 * i}.jpg" for i in range(8)]
    truth = room_with_depth.replace(images=room_with_depth.images[:8])
    check_cameras(scene, truth)
    (note,) = texts(scene)
    assert note.startswith("There are 9 photographs and 18 poses in")
    assert note.endswith(f"in {export / 'EXR_RGBD'}: the 8 of the same number are used.")


def test_one_camera_where_frames_have_none_of_their_own(export, room_with_depth):
    path = export / "EXR_RGBD/metadata.json"
    pinholes = json.loads(path.read_text())["perFrameIntrinsicCoeffs"]
    pinholes[1][0] += 5
    change(path, perFrameIntrinsicCoeffs=pinholes[:2])  # of later frames: K
    scene = load(export)
    focal = [image.camera.K[0, 0] for image in scene.images]
    first = room_with_depth.images[0].camera.K[0, 0]
    np.testing.assert_allclose(focal, [first, first + 5, *[first] * 7])
    assert len(scene.intrinsics) == 2
    change(path, perFrameIntrinsicCoeffs=None)
    check_cameras(load(export), room_with_depth)


def test_lost_tracking_leaves_an_image_out(export):
    path = export / "EXR_RGBD/metadata.json"
    poses = json.loads(path.read_text())["poses"]
    poses[3] = [0] * 7
    change(path, poses=poses)
    scene = load(export)
    assert scene.absent == ("3.jpg",)
    assert "1 of 9 images is left out (3.jpg)" in texts(scene)[0]
    assert scene.depths is None or "3.jpg" not in scene.depths


def test_of_a_long_recording_the_sharpest_are_used(export, monkeypatch):
    rgb = export / "EXR_RGBD/rgb"
    for number in (1, 4, 7):
        photograph = PilImage.open(rgb / f"{number}.jpg").reduce(4).resize((96, 72))
        photograph.save(rgb / f"{number}.jpg")
    monkeypatch.setattr("splatseed.io.recordings.FILM", FilmSettings(max_photographs=8))
    scene = load(export)
    numbers = {int(Path(image.name).stem) for image in scene.images}
    assert not numbers & {1, 4, 7}
    assert 5 <= len(numbers) <= 8
    (note,) = texts(scene)
    assert note.startswith(f"{len(numbers)} of 9 photographs are used: the sharpest")


def test_an_archive_is_extracted_once(room_with_depth, tmp_path, captures, lzfse):
    path = write_r3d(room_with_depth, tmp_path / "walk.r3d", step=2)
    scene = load(path)
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    (folder,) = captures.iterdir()
    assert (scene.source.root, scene.source.again) == (folder, path)
    assert texts(scene)[0].endswith(f"18 poses in {path}: the 9 of the same number are used.")
    before = {file: file.stat().st_mtime_ns for file in folder.rglob("*")}
    again = load(path.rename(tmp_path / "moved.r3d"))
    assert {file: file.stat().st_mtime_ns for file in folder.rglob("*")} == before
    assert again.source.root != folder  # of its own name
    with zipfile.ZipFile(again.source.again) as archive:
        for image in scene.images:
            assert image.path.read_bytes() == archive.read(f"rgbd/{image.name}")


def test_an_unpacked_archive_keeps_its_photographs(room_with_depth, tmp_path, captures, lzfse):
    path, folder = write_r3d(room_with_depth, tmp_path / "walk.r3d"), tmp_path / "walk"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    before = contents(folder)
    scene = load(folder)
    assert scene.findings == ()
    assert scene.source.image_dir == folder / "rgbd"
    check_cameras(scene, room_with_depth)
    check_depths(scene, room_with_depth)
    assert contents(folder) == before


def test_depth_of_an_archive_needs_a_package(room_with_depth, tmp_path, captures, no_lzfse):
    path = write_r3d(room_with_depth, tmp_path / "walk.r3d")
    scene = load(path)
    check_cameras(scene, room_with_depth)
    assert scene.depths is None
    (note,) = texts(scene)
    assert "needs lzfse. Install it (extra r3d):" in note


def test_maps_come_once_the_package_is_installed(
    room_with_depth, tmp_path, captures, lzfse, monkeypatch
):
    path = write_r3d(room_with_depth, tmp_path / "walk.r3d")
    with monkeypatch.context() as before:
        before.setattr("splatseed.requirements.find_spec", lambda _: None)
        assert load(path).depths is None
    check_depths(load(path), room_with_depth)


def test_outputs_copy_what_is_in_the_cache(room_with_depth, tmp_path, captures, lzfse):
    scene = load(write_r3d(room_with_depth, tmp_path / "walk.r3d"))
    out = write_scene(scene, tmp_path / "out", require_points=False).path
    assert not (out / "images").is_symlink()
    assert json.loads((out / "splatseed.json").read_text())["source"] == str(tmp_path / "walk.r3d")
    for folder in captures.iterdir():
        folder.rename(tmp_path / "gone")
    check_cameras(load(out), room_with_depth)
    assert load(out).has_photographs


def test_a_scene_written_elsewhere_finds_the_same_maps(room_with_depth, tmp_path, captures, lzfse):
    path = write_r3d(room_with_depth, tmp_path / "walk.r3d")
    out = write_scene(load(path), tmp_path / "out", require_points=False).path
    again = load(out)
    some = again.replace(images=again.images[:3])
    maps = find_depths(some, path)
    assert [*maps] == [image.name for image in some.images]
    check_depths(
        some.replace(depths=maps), room_with_depth.replace(images=room_with_depth.images[:3])
    )
    renamed = some.replace(images=tuple(replace(im, name=f"x{im.name}") for im in some.images))
    with pytest.raises(SceneNotFoundError, match="depth maps of the scene's images"):
        find_depths(renamed, path)


def test_nothing_half_extracted_remains(room_with_depth, tmp_path, captures, lzfse):
    path = write_r3d(room_with_depth, tmp_path / "walk.r3d")
    data = path.read_bytes()
    at = data.index(b"bvx-") + 4000  # within a map: its check sum is wrong
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(SceneFormatError, match=r"with rgbd/0\.depth undamaged; found .*CRC"):
        load(path)
    assert not [*captures.iterdir()]
    path.write_bytes(data)
    assert len(load(path).images) == 9


def test_a_cache_that_cannot_be_written(room_with_depth, tmp_path, monkeypatch):
    monkeypatch.setattr("splatseed.io.recordings._base", lambda: tmp_path / "file/captures")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="user's cache folder, which XDG_CACHE_HOME sets"):
        load(write_r3d(room_with_depth, tmp_path / "walk.r3d"))


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"poses": None}, r"metadata\.json to be Record3D's metadata.*found no 'poses'"),
        ({"w": None}, "found no 'w'"),
        ({"K": [9, 0, 5, 0, 9, 4, 0, 0, 1]}, "not column by column"),
        ({"K": [9, 9, 5, 4]}, "lists of 4 numbers, not 9"),
        ({"poses": [[0, 0, 0, 1, 2, 3]] * 9}, "lists of 6 numbers, not 7"),
        ({"poses": [[1, 2, 3, 0, 0, 0, 1]] * 9}, r"qx qy qz qw of length 1 in .*pose 0"),
        ({"poses": "many"}, "found"),
        ({"poses": [[float("nan")] * 7] * 9}, "finite pose"),
        ({"w": 48, "h": 36}, "middle of 48 x 36 pixels"),
    ],
)
def test_malformed_metadata_are_one_error(export, fields, match):
    change(export / "EXR_RGBD/metadata.json", perFrameIntrinsicCoeffs=None, **fields)
    with pytest.raises(SceneFormatError, match=match):
        load(export)


def test_incomplete_exports_are_told_apart(export, tmp_path):
    root = export / "EXR_RGBD"
    change(root / "metadata.json", poses=[])
    with pytest.raises(
        SceneNotFoundError, match=r"found none, as in recordings of the front camera"
    ):
        load(export)
    (root / "metadata.json").unlink()
    if (root / "depth/0.exr").is_file():
        with pytest.raises(SceneNotFoundError, match=r'no such file\. In the app.*"EXR \+ RGB"'):
            load(export)
    (root / "metadata.json").write_text(json.dumps({"w": 1}))
    for path in (root / "rgb").iterdir():
        path.unlink()
    with pytest.raises(SceneFormatError, match="found no 'K'"):
        load(export)
    video = tmp_path / "rgbd.mp4"
    video.write_bytes(b"\0" * 99 + b'{"intrinsicMatrix":[1],"rangeOfEncodedDepth":[0,3]}')
    with pytest.raises(SceneFormatError, match=r'"RGBD video", which has no poses\. .*as \.r3d'):
        load(video)
    with zipfile.ZipFile(tmp_path / "other.r3d", "w") as archive:
        archive.writestr("readme", b"")
    with pytest.raises(SceneFormatError, match="an archive of Record3D; found no 'metadata'"):
        load(tmp_path / "other.r3d")
    (tmp_path / "cut.r3d").write_bytes(b"PK\3\4" + b"\0" * 99)
    with pytest.raises(SceneFormatError, match=r"cut\.r3d to be an archive of Record3D"):
        load(tmp_path / "cut.r3d")
