"""COLMAP's files in both forms: byte for byte, judged by pycolmap, and errors with their place."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import OutputError, SceneFormatError
from splatseed.io import colmap

from .checks import CAMERAS
from .conftest import Model, written

REAL_MODELS = [
    f"{scene}/sparse/0" for scene in ("fern", "fox", "treehill", "bonsai", "mipnerf360_sfm/stump")
]


def read(folder, suffix="bin"):
    cameras = colmap.read_cameras(folder / f"cameras.{suffix}")
    images = colmap.read_images(folder / f"images.{suffix}", cameras)
    return cameras, images, *colmap.read_points3d(folder / f"points3D.{suffix}")


@pytest.mark.parametrize("model_dir", REAL_MODELS)
def test_real_models_are_written_back_byte_for_byte(scenes, model_dir, tmp_path):
    source = scenes / model_dir
    cameras = colmap.read_cameras(source / "cameras.bin")
    has_images = (source / "images.bin").exists()
    images = colmap.read_images(source / "images.bin", cameras) if has_images else ()
    written(tmp_path, Model(cameras, images, *colmap.read_points3d(source / "points3D.bin")))
    for path in source.glob("*.bin"):
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


@pytest.mark.parametrize(("name", "data"), [("a.bin", bytes(8)), ("a.txt", b"# nothing\n")])
def test_empty_models_are_models(tmp_path, name, data):
    path = tmp_path / name
    path.write_bytes(data)
    assert colmap.read_cameras(path) == colmap.read_images(path, ()) == ()
    points, tracks = colmap.read_points3d(path)
    assert len(points) == len(tracks) == 0
    assert (tracks.offsets.tolist(), tracks.image_ids.dtype) == ([0], np.uint32)


@pytest.mark.parametrize("change", [{"name": "a\0b"}, {"name": "\udcff"}, {"image_id": -1}])
def test_images_that_the_form_cannot_hold_are_refused(model, change, tmp_path):
    with pytest.raises(OutputError):
        colmap.write_images(tmp_path / "images.bin", [replace(model.images[0], **change)])


def test_text_may_have_comments_blank_lines_any_line_ends_and_names_with_spaces(tmp_path):
    text = "\ufeff# a comment\r\n\r\n  1 PINHOLE 640 480 500 5e2 320.0 240\r\n# the end"
    (tmp_path / "cameras.txt").write_text(text, "utf-8", newline="")
    assert colmap.read_cameras(tmp_path / "cameras.txt") == CAMERAS
    lines = ["# images", *(f"{i} 1 0 0 0 0 0 0 1 my photos/{i}  b.jpg \n" for i in (1, 2))]
    lines[2] += "1 2 -1 3 4 9\n3 1 0 0 0 0 0 0 1 c.jpg"  # whose line of features is missing
    (tmp_path / "images.txt").write_text("\n".join(lines))
    images = colmap.read_images(tmp_path / "images.txt", CAMERAS)
    assert [image.name for image in images] == ["my photos/1  b.jpg", "my photos/2  b.jpg", "c.jpg"]
    assert [len(image.observations) for image in images] == [0, 2, 0]
    assert images[1].observations.xy.tolist() == [[1, 2], [3, 4]]
    assert images[1].observations.point_ids.tolist() == [-1, 9]


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_every_camera_model_is_read_in_both_forms(name, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="writes the model")
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(7, name, 500.0, 640, 480)
    made.add_camera_with_trivial_rig(camera)
    made.write_binary(tmp_path)
    made.write_text(tmp_path)
    for suffix in ("bin", "txt"):
        (read_back,) = colmap.read_cameras(tmp_path / f"cameras.{suffix}")
        assert read_back == Intrinsics(7, name, 640, 480, tuple(camera.params))


@pytest.mark.parametrize(
    ("model_id", "says"),
    [
        (18, r"cameras.bin, record 1 of 1.*18, of a newer COLMAP.*image_undistorter"),
        (-1, r"id of a COLMAP camera model.*Copy the file again"),
        (2**30, r"id of a COLMAP camera model.*Copy the file again"),
    ],
)
def test_models_of_the_future_are_no_damage(model_id, says, tmp_path):
    path = tmp_path / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ2d", 1, 7, model_id, 64, 32, 64.0, 32.0))
    with pytest.raises(SceneFormatError, match=says):
        colmap.read_cameras(path)


def test_panoramas_are_read(tmp_path):
    """As COLMAP writes them, and as it did before its release."""
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 7, 17, 64, 32, 64.0, 32.0))
    (tmp_path / "cameras.txt").write_text("7 SPHERICAL 64 32 64 32\n")
    expected = (Intrinsics(7, "EQUIRECTANGULAR", 64, 32, (64.0, 32.0)),)
    for suffix in ("bin", "txt"):
        assert colmap.read_cameras(tmp_path / f"cameras.{suffix}") == expected
    colmap.write_cameras(tmp_path / "again.bin", expected)
    assert (tmp_path / "again.bin").read_bytes() == (tmp_path / "cameras.bin").read_bytes()


# COLMAP itself is the judge of what its formats say.


def assert_agree(reconstruction, cameras, images, points, tracks):
    theirs = reconstruction.cameras.items()
    of_theirs = [(i, c.model.name, c.width, c.height, tuple(c.params)) for i, c in theirs]
    of_ours = [(c.camera_id, c.model, c.width, c.height, c.params) for c in cameras]
    assert sorted(of_theirs) == sorted(of_ours)
    assert set(reconstruction.images) == {image.image_id for image in images}
    for image in images:
        theirs = reconstruction.images[image.image_id]
        assert (theirs.name, theirs.camera_id) == (image.name, image.intrinsics.camera_id)
        np.testing.assert_allclose(
            theirs.cam_from_world().matrix(), image.camera.cam_from_world[:3], atol=1e-12
        )
        ids = [p.point3D_id if p.has_point3D() else -1 for p in theirs.points2D]
        assert ids == image.observations.point_ids.tolist()
        np.testing.assert_array_equal([p.xy for p in theirs.points2D], image.observations.xy)
    assert set(reconstruction.points3D) == set(tracks.point_ids.tolist())
    each = [reconstruction.points3D[i] for i in tracks.point_ids.tolist()]
    np.testing.assert_array_equal([point.xyz for point in each], tracks.xyz)
    np.testing.assert_array_equal([point.color for point in each], points.rgb)
    np.testing.assert_array_equal([point.error for point in each], tracks.errors)
    elements = [[(e.image_id, e.point2D_idx) for e in point.track.elements] for point in each]
    np.testing.assert_array_equal([len(track) for track in elements], tracks.lengths)
    ours = np.stack([tracks.image_ids, tracks.point2d_idx], axis=1)
    np.testing.assert_array_equal(np.concatenate(elements), ours)


def test_pycolmap_reads_what_we_write_and_we_what_it_writes(model, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    first, *rest = model.images
    model = model._replace(images=(replace(first, name="an été.jpg"), *rest))
    reconstruction = pycolmap.Reconstruction(written(tmp_path, model))
    assert_agree(reconstruction, *model)
    (tmp_path / "theirs").mkdir()
    reconstruction.write_binary(tmp_path / "theirs")
    reconstruction.write_text(tmp_path / "theirs")
    for suffix in ("bin", "txt"):
        assert_agree(reconstruction, *read(tmp_path / "theirs", suffix))
