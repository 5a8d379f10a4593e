from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.io.colmap import text as colmap_text

CAMERAS = (Intrinsics(1, "PINHOLE", 640, 480, (500.0, 500.0, 320.0, 240.0)),)


def _text(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "model.txt"
    path.write_text(text, encoding="utf-8", newline="")
    return path


def test_comments_blank_lines_and_line_ends_do_not_matter(tmp_path):
    text = "\ufeff# a comment\r\n\r\n  1 PINHOLE 640 480 500 5e2 320.0 240\r\n# the end"
    assert colmap_text.read_cameras(_text(tmp_path, text)) == CAMERAS


def test_feature_lines_may_be_blank_or_missing(tmp_path):
    text = "# images\n1 1 0 0 0 0 0 0 1 a.jpg\n\n\n2 1 0 0 0 0 0 0 1 b.jpg\n1 2 -1 3 4 9\n3 1 0 0 0 0 0 0 1 c.jpg"  # noqa: E501  (one file in one text)
    images = colmap_text.read_images(_text(tmp_path, text), CAMERAS)
    assert [image.name for image in images] == ["a.jpg", "b.jpg", "c.jpg"]
    assert [len(image.observations) for image in images] == [0, 2, 0]
    assert images[1].observations.xy.tolist() == [[1, 2], [3, 4]]
    assert images[1].observations.point_ids.tolist() == [-1, 9]


def test_names_may_hold_spaces(tmp_path):
    text = "1 1 0 0 0 0 0 0 1 my photos/a  b.jpg \n\n"
    (image,) = colmap_text.read_images(_text(tmp_path, text), CAMERAS)
    assert image.name == "my photos/a  b.jpg"


def test_empty_files_are_empty_models(tmp_path):
    path = _text(tmp_path, "# nothing\n")
    assert colmap_text.read_cameras(path) == ()
    assert colmap_text.read_images(path, ()) == ()
    points, tracks = colmap_text.read_points3d(path)
    assert len(points) == len(tracks) == 0
    assert tracks.image_ids.dtype == np.uint32


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\n1 PINHOLE 640", r"CAMERA_ID MODEL .* in .*model\.txt, line 2; found '1 PINHOLE 640'"),
        ("1 PINHOLE 640 x 1 2 3 4", "line 1"),
        ("1 LENS 640 480 1 2 3 4", "one of COLMAP's models .*line 1; found 'LENS'"),
        ("1 PINHOLE 640 480 1 2 3", "4 parameters in .*line 1; found 3"),
        ("1 PINHOLE 640 480 1 2 3 nan", "finite camera parameters"),
        ("1 PINHOLE -640 480 1 2 3 4", "size in pixels"),
        ("-1 PINHOLE 640 480 1 2 3 4", "a camera id"),
        ("1 PINHOLE 6 4 1 2 3 4\n# c\n1 PINHOLE 6 4 1 2 3 4", "camera id once in .*line 3"),
    ],
)
def test_malformed_cameras_name_the_line(tmp_path, text, message):
    with pytest.raises(SceneFormatError, match=message):
        colmap_text.read_cameras(_text(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# c\n1 1 0 0 0 0 0 0 1\n\n", "IMAGE_ID QW .* in .*line 2; found"),
        ("1 1 0 0 0 0 0 x 1 a.jpg\n\n", "line 1"),
        ("1 1 0 0 0 0 0 0 1.0 a.jpg\n\n", "line 1"),
        ("1 nan 0 0 0 0 0 0 1 a.jpg\n\n", "a finite pose of image 'a.jpg' in .*line 1"),
        ("1 0 0 0 0 0 0 0 1 a.jpg\n\n", "a rotation quaternion"),
        ("1 1 0 0 0 0 0 0 5 a.jpg\n\n", "camera records in .*line 1; found camera id 5"),
        ("4294967296 1 0 0 0 0 0 0 1 a.jpg\n\n", "an image id"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n1 2\n", "X Y POINT3D_ID triples in .*line 2; found '1 2'"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n1 2 x\n", "triples"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n1 2 9223372036854775808\n", "triples"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n1 2 -2\n", "point ids from -1"),
        ("1 1 0 0 0 0 0 0 1 a\n2 1 0 0 0 0 0 0 1 b\n", "triples in .*line 2"),
        ("1 1 0 0 0 0 0 0 1 a\n\n1 1 0 0 0 0 0 0 1 b\n", "image id once in .*line 3; found 1"),
    ],
)
def test_malformed_images_name_the_line(tmp_path, text, message):
    with pytest.raises(SceneFormatError, match=message):
        colmap_text.read_images(_text(tmp_path, text), CAMERAS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# c\n\n1 0 0 0 1 2 3", "POINT3D_ID .* in .*line 3; found '1 0 0 0 1 2 3'"),
        ("1 0 0 0 1 2 3 .5 4", "IMAGE_ID POINT2D_IDX"),
        ("1 0 0 0 1 2 3 .5\n2 0 x 0 1 2 3 .5", "numbers in .*line 2; found '0 x 0'"),
        ("1 0 0 0 1 2 3 .5\n2 0 0 0 1 2 256 .5", "from 0 to 255 in .*line 2; found '1 2 256'"),
        ("1 0 0 0 1 2 3 .5 4 5\n2 0 0 0 1 2 3 .5 4 -1", "4294967295 in .*line 2; found '4 -1'"),
        ("1 0 0 0 1 2 3 .5\n9223372036854775808 0 0 0 1 2 3 .5", "line 2"),
        ("-1 0 0 0 1 2 3 .5", "line 1"),
        ("7 0 0 0 1 2 3 .5\n# c\n7 0 0 0 1 2 3 .5", "point id once in .*line 3; found 7"),
    ],
)
def test_malformed_points_name_the_line(tmp_path, text, message):
    with pytest.raises(SceneFormatError, match=message):
        colmap_text.read_points3d(_text(tmp_path, text))


def test_other_encodings_name_the_line(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_bytes(b"# one\n# caf\xe9\n")
    with pytest.raises(SceneFormatError, match=r"UTF-8 text in .*line 2"):
        colmap_text.read_cameras(path)
