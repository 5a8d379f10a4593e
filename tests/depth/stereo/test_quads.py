"""Grey images and what lies between their pixels."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from splatseed.depth.stereo.cost import grey_image, make_quads, sample
from splatseed.runtime.simd import LANES, load, store

from .references import bilinear


@njit
def _sample(quads, width, height, columns, rows, out):
    store(out, 0, sample(quads, width, height, load(columns, 0), load(rows, 0)))


def sampled(image: np.ndarray, columns, rows) -> np.ndarray:
    out = np.full(LANES, -1.0, np.float32)
    height, width = image.shape
    places = [np.resize(np.float32(each), LANES) for each in (columns, rows)]
    _sample(make_quads(image).ravel(), width, height, *places, out)
    return out


@pytest.mark.parametrize("shape", [(7, 9), (1, 5), (6, 1), (1, 1)])
def test_between_pixels_and_beyond_the_border(shape, rough, rng):
    image = rough(*shape)
    for _ in range(20):
        columns = rng.uniform(-3, shape[1] + 2, LANES).astype(np.float32)
        rows = rng.uniform(-3, shape[0] + 2, LANES).astype(np.float32)
        expected = [bilinear(image, x, y) for x, y in zip(columns, rows, strict=True)]
        np.testing.assert_allclose(sampled(image, columns, rows), expected, atol=1e-3)


def test_places_that_are_no_numbers_read_some_pixel(rough):
    image = rough(5, 6)
    odd = [np.nan, np.inf, -np.inf, 3e38, -3e38]
    expected = [image[0, 0], image[0, -1], image[0, 0], image[0, -1], image[0, 0]]
    np.testing.assert_array_equal(sampled(image, odd, [0.0])[: len(odd)], expected)


def test_grey_is_the_luma_of_the_colours(rng):
    image = rng.integers(0, 256, (8, 5, 3), dtype=np.uint8)
    expected = np.rint(image.astype(float) @ [0.299, 0.587, 0.114])
    assert np.abs(grey_image(image) - expected).max() <= 1  # where rounding is a toss-up
    flat = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, axis=2)
    np.testing.assert_array_equal(grey_image(flat)[0], np.arange(256))
