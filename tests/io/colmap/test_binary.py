from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.errors import OutputError, PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.io import files
from splatseed.io.colmap import binary as colmap_binary
from splatseed.pointcloud import PointCloud

REAL_MODELS = [
    f"{scene}/sparse/0" for scene in ("fern", "fox", "treehill", "bonsai", "mipnerf360_sfm/stump")
]
CAMERA = struct.pack("<QIiQQ4d", 1, 1, 1, 640, 480, 500, 500, 320, 240)
IMAGE = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.jpg\0" + struct.pack("<Q", 0)
POINT = struct.pack("<Q3d3BdQ2I", 1, 0, 0, 0, 1, 2, 3, 0.5, 1, 1, 0)  # without the file's count


def _bytes(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "model.bin"
    path.write_bytes(data)
    return path


def _points(*records: bytes) -> bytes:
    return struct.pack("<Q", len(records)) + b"".join(records)


def _point(point_id: int = 1, track_length: int = 0) -> bytes:
    return struct.pack("<Q3d3BdQ", point_id, 0, 0, 0, 1, 2, 3, 0.5, track_length)


def _read_images(path: Path):
    return colmap_binary.read_images(path, colmap_binary.read_cameras(path.parent / "cameras.bin"))


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "cameras.bin").write_bytes(CAMERA)
    return tmp_path


@pytest.mark.parametrize("model_dir", REAL_MODELS)
def test_real_models_are_written_back_byte_for_byte(scenes, model_dir, tmp_path):
    source = scenes / model_dir
    cameras = colmap_binary.read_cameras(source / "cameras.bin")
    colmap_binary.write_cameras(tmp_path / "cameras.bin", cameras)
    points, tracks = colmap_binary.read_points3d(source / "points3D.bin")
    colmap_binary.write_points3d(tmp_path / "points3D.bin", points, tracks)
    if (source / "images.bin").exists():
        images = colmap_binary.read_images(source / "images.bin", cameras)
        colmap_binary.write_images(tmp_path / "images.bin", images)
    for written in tmp_path.iterdir():
        assert written.read_bytes() == (source / written.name).read_bytes(), written.name


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_models_survive_a_round_trip(
    models, assert_same_images, assert_same_points, tmp_path_factory, data
):
    model, path = data.draw(models), tmp_path_factory.getbasetemp() / "round_trip.bin"
    colmap_binary.write_cameras(path, model.intrinsics)
    assert colmap_binary.read_cameras(path) == model.intrinsics
    colmap_binary.write_images(path, model.images)
    assert_same_images(colmap_binary.read_images(path, model.intrinsics), model.images)
    colmap_binary.write_points3d(path, model.points, model.tracks)
    assert_same_points(colmap_binary.read_points3d(path), (model.points, model.tracks))


def test_new_points_follow_the_tracked_ones(model, rng, tmp_path, monkeypatch):
    monkeypatch.setattr(colmap_binary, "_POINTS_AT_ONCE", 4)  # several writes with tracks
    path = tmp_path / "points3D.bin"
    new = PointCloud(rng.normal(size=(3, 3)), np.full((3, 3), 9, np.uint8))
    points = PointCloud.concatenate(model.points, new)
    colmap_binary.write_points3d(path, points, model.tracks)
    read, tracks = colmap_binary.read_points3d(path)
    np.testing.assert_array_equal(read.xyz, points.xyz)
    np.testing.assert_array_equal(read.rgb, points.rgb)
    assert tracks.point_ids.tolist() == [*model.tracks.point_ids, 31, 32, 33]
    assert tracks.errors.tolist() == [*model.tracks.errors, -1.0, -1.0, -1.0]
    assert tracks.lengths.tolist() == [4] * 10 + [0] * 3
    np.testing.assert_array_equal(tracks.xyz[:10], model.tracks.xyz)
    np.testing.assert_array_equal(tracks.image_ids, model.tracks.image_ids)


def test_points_without_tracks_are_numbered_from_one(model, tmp_path):
    path = tmp_path / "points3D.bin"
    colmap_binary.write_points3d(path, model.points, None)
    points, tracks = colmap_binary.read_points3d(path)
    np.testing.assert_array_equal(points.xyz, model.points.xyz)
    assert tracks.point_ids.tolist() == list(range(1, 11))
    assert set(tracks.errors) == {-1.0}
    assert not tracks.lengths.any()


def test_more_tracks_than_points_are_refused(model, tmp_path):
    with pytest.raises(PointCloudError, match="10 tracks for 4 points"):
        colmap_binary.write_points3d(
            tmp_path / "points3D.bin", model.points.select(slice(4)), model.tracks
        )


def test_empty_models_are_models(folder):
    path = _bytes(folder, struct.pack("<Q", 0))
    assert colmap_binary.read_cameras(path) == ()
    assert _read_images(path) == ()
    points, tracks = colmap_binary.read_points3d(path)
    assert len(points) == len(tracks) == 0
    assert tracks.offsets.tolist() == [0]


def test_non_finite_points_pass(tmp_path):
    record = struct.pack("<Q3d3BdQ", 5, np.nan, np.inf, 1e300, 1, 2, 3, np.nan, 0)
    points, tracks = colmap_binary.read_points3d(_bytes(tmp_path, _points(record)))
    np.testing.assert_array_equal(points.xyz, [[np.nan, np.inf, np.inf]])
    np.testing.assert_array_equal(tracks.xyz, [[np.nan, np.inf, 1e300]])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", r"8 more bytes in .*model\.bin, header, byte 0; found 0"),
        (CAMERA[:40], "at most 0 cameras"),
        (CAMERA[:-1], r"record 1 of 1.*; found 31"),
        (CAMERA + b"\0", "the end of the file in .*found 1 more bytes"),
        (struct.pack("<Q", 2**60) + CAMERA[8:], "at most 1 cameras.*1152921504606846976 promised"),
        (struct.pack("<Q", 2) + 2 * CAMERA[8:], "each camera id once in .*record 2"),
        (CAMERA[:12] + struct.pack("<i", 99) + CAMERA[16:], "camera model.*record 1.*found 99"),
        (CAMERA[:16] + struct.pack("<Q", 0) + CAMERA[24:], "size in pixels.*found 0 x 480"),
        (CAMERA[:16] + struct.pack("<Q", 2**63) + CAMERA[24:], "size in pixels"),
        (CAMERA[:32] + struct.pack("<d", np.nan) + CAMERA[40:], "finite camera parameters"),
    ],
)
def test_malformed_cameras_name_the_record(tmp_path, data, message):
    with pytest.raises(SceneFormatError, match=message):
        colmap_binary.read_cameras(_bytes(tmp_path, data))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (IMAGE[:50], "at most 0 images"),
        (IMAGE + b"rest", r"the end of the file in .*model\.bin, end.*found 4 more bytes"),
        (struct.pack("<Q", 2**60) + IMAGE[8:], "at most 1 images"),
        (struct.pack("<Q", 2) + 2 * IMAGE[8:], "each image id once in .*record 2; found 1"),
        (IMAGE[:12] + struct.pack("<d", np.nan) + IMAGE[20:], "a finite pose of image 'a.jpg'"),
        (IMAGE[:44] + struct.pack("<d", np.inf) + IMAGE[52:], "a finite pose"),
        (IMAGE[:12] + struct.pack("<d", 0) + IMAGE[20:], "a rotation quaternion"),
        (IMAGE[:68] + struct.pack("<I", 8) + IMAGE[72:], "'a.jpg' to name one .*found camera id 8"),
        (IMAGE[:72] + b"\xff.jpg\0" + IMAGE[-8:], "a name in UTF-8 in .*record 1 of 1"),
        (IMAGE[:72] + b"no end" + 20 * b"x", "ended by a zero byte"),
        (IMAGE[:72] + b"\0" + IMAGE[-8:], "an image name in .*record 1 of 1"),
        (IMAGE[:-8] + struct.pack("<Q", 2**60), "at most 0 features"),
        (
            IMAGE[:-8] + struct.pack("<QddQ", 1, 0, 0, 2**63),
            "point ids below 2.63 in .*record 1 of 1",
        ),
    ],
)
def test_malformed_images_name_the_record(folder, data, message):
    with pytest.raises(SceneFormatError, match=message):
        _read_images(_bytes(folder, data))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\1\0\0", "8 more bytes"),
        (_points(_point())[:-1], "at most 0 points"),
        (_points(_point(track_length=1)), r"whole point record in .*record 1 of 1, byte 8"),
        (_points(_point(), POINT)[:-1], r"record 2 of 2, byte 59; found 58 bytes"),
        (_points(POINT) + b"\0", "the end of the file.*found 1 more bytes"),
        (struct.pack("<Q", 2**60) + POINT, "at most 1 points.*found 1152921504606846976"),
        (struct.pack("<Q", 2**64 - 1) + POINT, "at most 1 points"),
        (_points(_point(track_length=2**60)), "whole point record"),
        (_points(_point(track_length=2**63)), "whole point record"),
        (_points(_point(track_length=2**64 - 1)), "whole point record"),
        (_points(_point(4), _point(5), _point(4)), "each point id once in .*record 3; found 4"),
        (_points(_point(4), _point(2**63)), "a point id from 0 .*record 2"),
    ],
)
def test_malformed_points_name_the_record(tmp_path, little_memory, data, message):
    path = _bytes(tmp_path, data)
    colmap_binary.read_points3d(_bytes(tmp_path, _points(POINT)))  # the kernels are loaded
    path.write_bytes(data)
    with little_memory(), pytest.raises(SceneFormatError, match=message):
        colmap_binary.read_points3d(path)


READERS = [
    colmap_binary.read_cameras,
    lambda path: colmap_binary.read_images(path, ()),
    colmap_binary.read_points3d,
]


@pytest.mark.parametrize("read", READERS)
def test_unreadable_files_are_our_errors(read, tmp_path, monkeypatch):
    with pytest.raises(SceneNotFoundError):
        read(tmp_path / "absent.bin")
    with pytest.raises(SceneNotFoundError):
        read(_bytes(tmp_path, b"") / "below_a_file.bin")
    with pytest.raises(SceneFormatError, match="readable"):
        read(tmp_path)

    def deny(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files, "read_file", deny)
    with pytest.raises(SceneFormatError, match="Permission denied"):
        read(tmp_path / "model.bin")


@pytest.mark.parametrize("change", [{"name": "a\0b"}, {"name": "\udcff"}, {"image_id": -1}])
def test_images_that_the_form_cannot_hold_are_refused(model, change, tmp_path):
    image = model.images[0]
    fields = {name: getattr(image, name) for name in image.__dataclass_fields__} | change
    with pytest.raises(OutputError):
        colmap_binary.write_images(tmp_path / "images.bin", [type(image)(**fields)])
