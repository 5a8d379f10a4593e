"""Photographs: pixels as stored, and damage found before it matters."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.io.masks import read_mask
from splatseed.io.photograph import check_photograph, decode_photograph, photograph_bytes
from splatseed.io.picture import find_white
from splatseed.photos.loading import load_views
from splatseed.scene import Masks

from ..findings import texts
from ..wide_png import png16


def decoded(path):
    return np.array(decode_photograph(path, photograph_bytes(path)))


def saved(tmp_path, array, name="a.tif", **options):
    PilImage.fromarray(array).save(tmp_path / name, **options)
    return decoded(tmp_path / name)


def test_pixels_are_as_stored_whatever_the_camera_says_is_up(rng, tmp_path):
    pixels = rng.integers(0, 256, (5, 9, 3), dtype=np.uint8)
    exif = PilImage.Exif()
    exif[0x0112] = 6  # to be shown turned by 90 degrees
    assert np.array_equal(saved(tmp_path, pixels, "turned.png", exif=exif), pixels)
    assert check_photograph(tmp_path / "turned.png") == (9, 5)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_file_cut_short_is_told_from_a_whole_one(suffix, rng, tmp_path):
    pixels = rng.integers(0, 256, (64, 96, 3), dtype=np.uint8)
    path = tmp_path / f"a{suffix}"
    PilImage.fromarray(pixels).save(path)
    assert check_photograph(path) == (96, 64)
    whole = path.read_bytes()
    for kept in (0, 5, 60, 97):
        path.write_bytes(whole[: len(whole) * kept // 100])
        with pytest.raises(SceneFormatError, match=f"a{suffix} to be an image"):
            check_photograph(path)
    with pytest.raises(SceneNotFoundError, match=r"gone\.jpg"):
        check_photograph(tmp_path / "gone.jpg")


ALL16 = np.arange(65536, dtype=np.uint16).reshape(256, 256)
NEAREST = np.rint(ALL16 / 65535 * 255)
"""Every number of 16 bits, and the nearest of 8 bits."""


def test_grey_of_16_bits_becomes_the_nearest_of_8(tmp_path, monkeypatch):
    for name in ("a.png", "a.tif"):
        pixels = saved(tmp_path, ALL16, name)
        assert pixels.dtype == np.uint8
        assert all(np.array_equal(pixels[..., channel], NEAREST) for channel in range(3))
    real = PilImage.open

    def as_32_bits(file, **_):
        """As before Pillow 11, whose reader its own conversion from I;16 stands in for."""
        picture = real(file).convert("I")
        picture.format = "PNG"
        return picture

    monkeypatch.setattr(PilImage, "open", as_32_bits)
    assert np.array_equal(decoded(tmp_path / "a.png")[..., 0], NEAREST)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_channels_of_16_bits_are_right_to_one_step(count, rng, tmp_path):
    channels = rng.integers(0, 65536, (32, 32, count))
    if count in {2, 4}:
        channels[..., -1] = 65535  # opaque
    (tmp_path / "a.png").write_bytes(png16(channels))
    expected = channels[..., :1] if count == 2 else channels[..., :3]
    assert np.abs(decoded(tmp_path / "a.png") - expected / 257).max() <= 1


@pytest.mark.parametrize("value", [1.5, -0.5, np.nan, 200, "CMYK", "LAB"])
def test_numbers_of_unknown_range_and_inks_are_refused(value, tmp_path):
    path = tmp_path / ("a.jpg" if value == "CMYK" else "a.tif")
    if isinstance(value, str):
        PilImage.new(value, (8, 8)).save(path)
    else:
        PilImage.new("I" if value == 200 else "F", (8, 8), value).save(path)
    with pytest.raises(SceneFormatError, match=r"8 or 16 bits|RGB"):
        decoded(path)


def test_grey_of_8_bits_palettes_and_floats_are_as_they_are(rng, tmp_path):
    grey = rng.integers(0, 256, (9, 7), np.uint8)
    assert np.array_equal(saved(tmp_path, grey, "a.png")[..., 2], grey)
    palette = PilImage.fromarray(grey).convert("RGB").quantize(16)
    palette.save(tmp_path / "p.png")
    assert np.array_equal(decoded(tmp_path / "p.png"), np.asarray(palette.convert("RGB")))
    floats = rng.random((16, 16)).astype(np.float32)
    assert np.array_equal(saved(tmp_path, floats)[..., 1], np.rint(floats * 255))


def test_one_too_large_for_pillow_is_to_be_made_smaller(tmp_path, monkeypatch):
    """A phone's 200 megapixels are over its limit."""
    monkeypatch.setattr(PilImage, "MAX_IMAGE_PIXELS", 10)
    PilImage.new("L", (8, 6)).save(path := tmp_path / "large.jpg")
    with pytest.raises(SceneFormatError, match=r"48 pixels.*Make a smaller copy"):
        decoded(path)


def test_transparent_pixels_are_black(tmp_path):
    for channels in (4, 2):
        values = np.full((4, 6, channels), 200, np.uint8)
        values[..., -1] = [0, 0, 0, 255, 255, 255]
        pixels = saved(tmp_path, values, "cut.png")
        assert (pixels == np.array([0, 0, 0, 200, 200, 200])[:, None]).all()
    (tmp_path / "a.png").write_bytes(png16(ALL16[..., None], transparent=65535))
    assert decoded(tmp_path / "a.png")[-1, -2:].tolist() == [[255, 255, 255], [0, 0, 0]]


def tiff16(values, path):
    """Write a little-endian TIFF of 16 bits of [H, W, 3], uncompressed."""
    height, width, count = values.shape
    data, at = values.astype("<u2").tobytes(), 8 + 2 + 12 * 10 + 4
    tags = [
        (256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, at), (259, 3, 1, 1), (262, 3, 1, 2),
        (273, 4, 1, at + 6), (277, 3, 1, count), (278, 3, 1, height), (279, 4, 1, len(data)),
        (284, 3, 1, 1),
    ]  # fmt: skip
    rows = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(4)
    path.write_bytes(head + struct.pack("<3H", 16, 16, 16) + data)


@pytest.mark.parametrize("count", [1, 2, 3, 4, "tif"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_photographs_of_fewer_bits_are_stretched_alike(count, bits, rng, tmp_path):
    """The brightest decides for all, so that a dark one stays dark."""
    channels, suffix = (3, "tif") if count == "tif" else (count, "png")
    opaque = 2**bits - 1 if channels == 4 else 65535
    bright = rng.integers(0, 2**bits, (6, 9, channels))
    bright[0, 0, 0] = 2**bits - 1
    paths = [tmp_path / f"{name}.{suffix}" for name in ("dark", "bright")]
    both = list(zip(paths, (bright // 16, bright), strict=True))
    for path, values in both:
        if channels in {2, 4}:
            values[..., -1] = opaque
        if count == "tif":
            tiff16(values, path)
        else:
            path.write_bytes(png16(values))
    white, found = find_white([*paths, tmp_path / "none.png"])
    assert white == 2**bits - 1
    said = f"only use {bits} (values up to {white:,})"
    assert [said in each.text for each in found] == ([True] if bits < 16 else [])
    for path, values in both:
        pixels = np.array(decode_photograph(path, photograph_bytes(path), white))
        colors = values[..., :1] if channels < 3 else values[..., :3]
        assert np.abs(pixels - 255 * colors / white).max() <= 0.51
        assert read_mask(Masks({}), path.name, path) is None  # all are opaque


def test_a_scene_of_14_bits_has_its_note_once_and_bright_views(room, tmp_path):
    write_scene(room.replace(images=room.images[:2]), tmp_path / "scene", copy_images=True)
    for image in room.images[:2]:
        pixels = np.asarray(PilImage.open(room.source.image_dir / image.name).convert("RGB"))
        values = np.rint(pixels * (16383 / 255)).astype(np.uint16)
        (tmp_path / "scene/images" / image.name).write_bytes(png16(values))
    scene = load_scene(tmp_path / "scene")
    assert sum("use 14 (values" in each for each in texts(scene)) == 1
    wide, plain = (load_views(each, each.images[:1])[0] for each in (scene, room))
    assert np.array_equal(wide.photograph, plain.photograph)
