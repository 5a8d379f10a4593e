"""Comparisons have names above them, and are split into their images again."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from splatseed.splat.pictures import (
    BAND,
    GAP,
    flip_heatmap,
    split_comparison,
    to_uint8,
    write_comparison,
)


@pytest.mark.parametrize("size", [(40, 200), (48, 64), (7, 5)])
def test_a_comparison_is_named_and_can_be_split(size, rng, tmp_path):
    photograph = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    photograph[0] = 255  # a white row is no band
    render, errors = rng.random((2, *size, 3), np.float32), rng.random(size, np.float32)
    write_comparison(tmp_path / "a.png", photograph, render[0], errors)
    picture = np.asarray(Image.open(tmp_path / "a.png"))
    parts = photograph, to_uint8(render[0]), flip_heatmap(errors)
    assert picture.shape == (size[0] + BAND, 3 * size[1] + 2 * GAP, 3)
    assert picture[:BAND].min() < 100
    if size[1] == 200:  # a name above each
        for i in range(3):
            assert picture[:BAND, i * (size[1] + GAP) :][:, : size[1]].min() < 100
    for whole in (picture, picture[BAND:]):  # the latter as versions before names wrote it
        for found, expected in zip(split_comparison(whole), parts, strict=True):
            np.testing.assert_array_equal(found, expected)
