"""Coverage: which cells hold a point, held to literal loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.errors import ParameterError, PointCloudError
from splatseed.seeding.coverage import cell_depths, covered_cells, covered_share

from . import references as slow


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 8, 100]), st.floats(0.01, 5.0))
@settings(max_examples=25, deadline=None)
def test_depths_are_those_of_the_loop(seed, cell, spread):
    rng = np.random.default_rng(seed)
    width, height = rng.integers(1, 50, 2)
    view = slow.make_view(rng, int(width), int(height), rng.uniform(1, 200))
    xyz = (spread * rng.normal(size=(rng.integers(0, 600), 3))).astype(np.float32)
    expected = slow.cell_depths(view, xyz, cell)
    np.testing.assert_array_equal(cell_depths(view, xyz, cell), expected)


def test_a_surface_hides_what_shows_between_its_points(rng):
    view = slow.make_view(rng, 80, 80, 80, eye=(0, -1, 0))
    distance = -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
    depth = np.linalg.norm(distance)
    i, j = np.divmod(np.arange(100), 10)
    sheet = np.array([slow.lift(view, 8, a, b, depth) for a, b in zip(i, j, strict=True)])
    hole = 44
    behind = slow.lift(view, 8, 4, 4, 1.5 * depth)
    slightly = slow.lift(view, 8, 4, 4, 1.05 * depth)
    others = np.delete(sheet, hole, axis=0)
    for point, covered in ((behind, 99), (slightly, 100)):
        (cells,) = covered_cells([view], np.vstack([others, point]).astype(np.float32))
        assert cells.sum() == covered
    assert covered_share([view], sheet.astype(np.float32)) == 1.0


def test_a_point_that_hangs_before_a_surface_does_not_hide_it(rng):
    view = slow.make_view(rng, 80, 80, 80, eye=(0, -1, 0))
    i, j = np.divmod(np.arange(100), 10)
    sheet = [slow.lift(view, 8, a, b, 4.0) for a, b in zip(i, j, strict=True) for _ in range(4)]
    stray = slow.lift(view, 8, 5, 5, 0.1)
    depths = cell_depths(view, np.float32([*sheet, stray]), 8)
    np.testing.assert_allclose(depths, 4.0, rtol=1e-5)


def test_bad_input_is_refused(rng):
    view, xyz = slow.make_view(rng), np.zeros((1, 3), np.float32)
    with pytest.raises(ParameterError, match="at least one view"):
        covered_share([], xyz)
    for cell in (0, 0.5, np.nan, np.inf):
        with pytest.raises(ParameterError, match="at least 1 pixel"):
            covered_share([view], xyz, cell)
    with pytest.raises(PointCloudError, match=r"\[N, 3\]"):
        covered_share([view], xyz[:, :2])
