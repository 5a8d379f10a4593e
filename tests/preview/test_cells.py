"""Cells take their colours to the pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PillowImage

from splatseed.errors import ParameterError
from splatseed.preview import CoveredView, cell_picture, preview_cells


@settings(deadline=None)
@given(data=st.data(), height=st.integers(1, 20), width=st.integers(1, 20), cell=st.integers(1, 9))
def test_a_pixel_is_dimmed_or_tinted_as_its_cell_is(data, height, width, cell):
    covered = data.draw(hnp.arrays(bool, (-(-height // cell), -(-width // cell))))
    photograph = np.full((height, width, 3), 200, np.uint8)
    picture = cell_picture(photograph, covered, cell)
    assert picture.shape == photograph.shape
    for row in range(height):
        for column in range(width):
            red, green, blue = picture[row, column].tolist()
            if covered[row // cell, column // cell]:
                assert red == green == blue == 150
            else:
                assert min(red, blue) > green + 50


@pytest.mark.parametrize("shape", [(2, 3), (3, 2), (4, 3)])
def test_cells_that_do_not_cover_the_picture_are_refused(shape):
    with pytest.raises(ParameterError, match="3 x 3 cells of 8 px for 20 x 24"):
        cell_picture(np.zeros((24, 20, 3), np.uint8), np.ones(shape, bool), 8)


@pytest.mark.parametrize("num_views", [1, 2, 3])
@pytest.mark.parametrize("added", [True, False])
def test_a_page_shows_the_cells_before_and_after(tmp_path, num_views, added):
    before, after = np.zeros((3, 4), bool), np.ones((3, 4), bool)
    photograph = np.full((24, 32, 3), 200, np.uint8)
    view = CoveredView("a.png", photograph, 8, before, after if added else None)
    path = preview_cells([view] * num_views, tmp_path / "cells.png")
    picture = np.asarray(PillowImage.open(path).convert("RGB")).astype(int)
    tinted = (picture[..., 0] - picture[..., 1] > 50) & (picture[..., 2] - picture[..., 1] > 50)
    assert tinted.sum() == num_views * 600 * 450
    dimmed = (picture == 150).all(axis=2).sum()  # labels have a few grey pixels too
    assert 0 <= dimmed - added * num_views * 600 * 450 < 200
