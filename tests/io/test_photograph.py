"""Photographs: pixels as stored, and damage found before it matters."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.photograph import check_photograph, decode_photograph, photograph_bytes


def _decoded(path):
    return np.array(decode_photograph(path, photograph_bytes(path)))


def test_pixels_are_as_stored_whatever_the_camera_says_is_up(rng, tmp_path):
    pixels = rng.integers(0, 256, (5, 9, 3), dtype=np.uint8)
    exif = PilImage.Exif()
    exif[0x0112] = 6  # to be shown turned by 90 degrees
    PilImage.fromarray(pixels).save(tmp_path / "turned.png", exif=exif)
    assert np.array_equal(_decoded(tmp_path / "turned.png"), pixels)
    assert check_photograph(tmp_path / "turned.png") == (9, 5)


def test_transparent_pixels_are_black(tmp_path):
    rgba = np.full((4, 6, 4), 200, np.uint8)
    rgba[:, :3, 3] = 0
    rgba[:, 3:, 3] = 255
    PilImage.fromarray(rgba).save(tmp_path / "cut.png")
    pixels = _decoded(tmp_path / "cut.png")
    assert (pixels[:, :3] == 0).all()
    assert (pixels[:, 3:] == 200).all()


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("kept", [0, 5, 60, 97])
def test_a_file_cut_short_is_told_from_a_whole_one(suffix, kept, rng, tmp_path):
    pixels = rng.integers(0, 256, (64, 96, 3), dtype=np.uint8)
    path = tmp_path / f"a{suffix}"
    PilImage.fromarray(pixels).save(path)
    assert check_photograph(path) == (96, 64)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * kept // 100])
    with pytest.raises(SceneFormatError, match=f"a{suffix} to be an image"):
        check_photograph(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneNotFoundError, match=r"gone\.jpg"):
        check_photograph(tmp_path / "gone.jpg")
