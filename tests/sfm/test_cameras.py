"""Which photographs share a camera."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from splatseed.sfm.cameras import (
    Exif,
    Photo,
    default_model,
    describe_cameras,
    read_exif,
    share_cameras,
)

SIZE = (4000, 3000)


def phone(focal, focal_35, lens="", size=SIZE):
    return Photo(size, Exif("Maker", "Phone", lens, focal, focal_35))


def shared(*kinds):
    """The numbers of photographs by camera, of (photograph, how many, folder)."""
    photos = {}
    for photo, count, *folder in kinds:
        for _ in range(count):
            photos["/".join([*folder, f"{len(photos):03}.jpg"])] = photo
    cameras = share_cameras(photos)
    assert sorted(name for each in cameras for name in each.names) == sorted(photos)
    assert all(each.typical in each.names for each in cameras)
    return [len(each.names) for each in cameras]


WIDE, TELE, NONE = phone(5.7, 26), phone(9.0, 77), Photo(SIZE)


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ([(WIDE, 8), (TELE, 8)], [8, 8]),
        ([(WIDE, 8), (TELE, 1)], [8, 1]),  # alone, but no part of the other lens
        ([(WIDE, 8), (phone(5.7, 27), 8)], [8, 8]),  # digital zoom
        ([(WIDE, 8), (Photo(SIZE, WIDE.exif._replace(zoom=2.0)), 8)], [8, 8]),
        ([(WIDE, 8), (phone(5.7, 26, "front"), 8)], [8, 8]),
        ([(WIDE, 8), (Photo(SIZE, Exif("Maker", "Drone", "", 5.7, 26)), 8)], [8, 8]),
        ([(WIDE, 8), (phone(5.7, 26, size=(3000, 4000)), 8)], [8, 8]),
        ([(phone(5.7, None), 8), (phone(9.0, None), 8)], [8, 8]),
        ([(phone(None, 26), 8), (phone(None, 77), 8)], [8, 8]),
        ([(NONE, 8)], [8]),
        ([(NONE, 8, "a"), (NONE, 8, "b")], [8, 8]),
        ([(NONE, 2, "a"), (NONE, 3, "b"), (NONE, 8, "c")], [5, 8]),
        ([(WIDE, 8), (NONE, 3)], [11]),  # EXIF got lost
        ([(WIDE, 8), (NONE, 8)], [8, 8]),
        ([(WIDE, 8), (TELE, 8), (NONE, 3)], [8, 8, 3]),
        ([(phone(24.0, 36), 9), (phone(24.1, 36), 9), (phone(24.2, 36), 2)], [20]),  # zoom ring
        ([(phone(24.0, 36), 9), (phone(25.0, 37), 2)], [11]),  # too few for a camera of their own
        ([(phone(24.0, 36), 9), (phone(25.0, 37), 9)], [9, 9]),
        ([(phone(24.0, 36), 9), (phone(70.0, 105), 9)], [9, 9]),
    ],
)
def test_photographs_of_one_setting_of_one_lens_share_a_camera(kinds, expected):
    assert shared(*kinds) == expected


def test_a_zoom_through_all_focal_lengths_gives_some_cameras_of_near_ones():
    lengths = np.geomspace(24, 70, 60)
    photos = {f"{i:03}.jpg": phone(f, round(1.5 * f)) for i, f in enumerate(lengths)}
    cameras = share_cameras(photos)
    assert 10 < len(cameras) < 30
    for each in cameras:
        focal = [photos[name].exif.focal for name in each.names]
        assert max(focal) / min(focal) <= 1.06
        assert min(focal) <= photos[each.typical].exif.focal <= max(focal)


def test_the_cameras_are_described():
    two = share_cameras({"a.jpg": WIDE, "b.jpg": TELE, "c.jpg": TELE})
    assert describe_cameras(two) == (
        "2 cameras by EXIF: Maker Phone at 26 mm (1 photograph), "
        "Maker Phone at 77 mm (2 photographs)"
    )
    assert describe_cameras(share_cameras({"a": NONE})) == "1 camera for all: EXIF names none"


def test_exif_is_read_and_what_is_none_of_it_left(tmp_path):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker\0", " Maker One "
    exif.get_ifd(0x8769).update({0x920A: 5.7, 0xA405: 0, 0xA434: "back camera", 0xA404: 1.0})
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    with Image.open(tmp_path / "a.jpg") as image:
        assert read_exif(image) == Exif("Maker", "Maker One", "back camera", 5.7, None)
    broken = (tmp_path / "a.jpg").read_bytes()
    at = broken.index(b"Exif\0\0")
    (tmp_path / "b.jpg").write_bytes(broken[: at + 8] + b"\xff" * 30 + broken[at + 38 :])
    with Image.open(tmp_path / "b.jpg") as image:
        assert read_exif(image) == Exif()


def test_distortion_is_estimated_of_many_photographs_only():
    assert [default_model(count) for count in (2, 15)] == ["SIMPLE_PINHOLE"] * 2
    assert [default_model(count) for count in (16, 300)] == ["OPENCV"] * 2
