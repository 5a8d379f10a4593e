"""Downsampling by area, against whole blocks of an enlarged picture."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from splatseed.io.downsampling import area_means, reduced_size, reduction
from splatseed.io.masks import read_mask
from splatseed.photos.loading import load_photograph, load_views
from splatseed.photos.sizes import factor_for_side
from splatseed.photos.view import camera_views
from splatseed.scene import Masks


def blocks(pixels, rows, columns):
    """The mean of each rectangle, by repeating each pixel until whole blocks cover it."""
    large = pixels.repeat(rows, 0).repeat(columns, 1).astype(float)
    height, width = pixels.shape[:2]
    return (
        large.reshape(rows, height, columns, width, -1)
        .mean((1, 3))
        .reshape(rows, columns, *pixels.shape[2:])
    )


@pytest.mark.parametrize("factor", [Fraction(21, 20), Fraction(7, 3), Fraction(21, 8), 3, 1])
def test_a_pixel_is_the_mean_over_its_rectangle(factor):
    pixels = np.random.default_rng(0).integers(0, 256, (21, 42, 3)).astype(np.uint8)
    columns, rows = reduced_size(42, 21, float(factor))
    assert (columns, rows) == (round(42 / factor), round(21 / factor))
    np.testing.assert_allclose(
        area_means(pixels, float(factor)), blocks(pixels, rows, columns), atol=1e-9
    )


def test_whole_factors_cut_the_edge_off_and_others_fill_the_size():
    assert reduced_size(505, 379, 2) == reduced_size(505, 379, 2.0) == (252, 189)
    assert reduction(505, 379, 2) == (0.5, 0.5)
    assert reduced_size(504, 378, 504 / 480) == (480, 360)
    assert reduction(505, 379, 505 / 480) == (480 / 505, 360 / 379)


def test_a_whole_number_as_a_float_gives_the_same_bytes(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (21, 43, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    np.testing.assert_array_equal(
        load_photograph(tmp_path / "a.png", 2), load_photograph(tmp_path / "a.png", 2.0)
    )
    some = load_photograph(tmp_path / "a.png", 43 / 30, tmp_path / "cache")
    assert some.shape == (15, 30, 3)
    np.testing.assert_array_equal(some, np.rint(blocks(pixels, 15, 30)))
    np.testing.assert_array_equal(
        some, load_photograph(tmp_path / "a.png", 43 / 30, tmp_path / "cache")
    )


def test_views_have_the_size_and_the_camera_exactly(room):
    factor = factor_for_side(room.images, 64)  # of 96 x 72
    assert factor == 1.5
    assert [factor_for_side(room.images, side) for side in (96, 100, 48)] == [1, 1, 2]
    (view,), (camera,) = (
        load_views(room, room.images[:1], data_factor=factor),
        camera_views(room.images[:1], factor),
    )
    assert view.photograph.shape == (48, 64, 3)
    for each in (view, camera):
        assert (each.camera.width, each.camera.height) == (64, 48)
        np.testing.assert_allclose(each.camera.K[:2], room.images[0].camera.K[:2] / 1.5)


def test_a_reduced_pixel_counts_if_all_of_its_pixels_do(tmp_path):
    Image.new("RGB", (42, 21)).save(tmp_path / "a.png")
    mask = np.full((21, 42), 255, np.uint8)
    mask[10, 22] = 0  # in columns 21 to 22.4 and 22.4 to 23.8, in rows 9.8 to 11.2
    Image.fromarray(mask).save(tmp_path / "mask.png")
    masks = Masks({"a": tmp_path / "mask.png"})
    counts = read_mask(masks, "a", tmp_path / "a.png", 1.4)
    assert counts.shape == (15, 30)
    assert np.argwhere(~counts).tolist() == [[7, 15], [7, 16]]
