"""Which cells hold a point, and which points are kept of too many: held to literal loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.errors import ParameterError, PointCloudError
from splatseed.photos.zbuffer import cell_depths
from splatseed.seeding.cover import covered_share
from splatseed.seeding.thinning import _places_in_views, thin

from . import references as slow


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 8, 100]), st.floats(0.01, 5.0))
@settings(max_examples=25, deadline=None)
def test_depths_are_those_of_the_loop(seed, cell, spread):
    rng = np.random.default_rng(seed)
    width, height = rng.integers(1, 50, 2)
    view = slow.make_view(rng, int(width), int(height), rng.uniform(1, 200))
    xyz = (spread * rng.normal(size=(rng.integers(0, 600), 3))).astype(np.float32)
    expected = slow.cell_depths(view, xyz, cell)
    np.testing.assert_array_equal(cell_depths(view.camera, xyz, cell), expected)


def lattice(view, cells, depth):
    """A point in the middle of each of some cells, at a depth."""
    return [slow.lift(view, 8, i, j, depth) for i, j in cells]


def sheet(rng, num):
    """Points on a bent sheet about 2 wide, dense on its left."""
    u, v = rng.random((2, num)) ** [[3], [1]] * 2 - 1
    return np.stack([u, v, 0.2 * np.sin(3 * u)], axis=1).astype(np.float32)


def views_of(rng, num):
    return [slow.make_view(rng, 64, 48, 60, name=f"{k}") for k in range(num)]


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 30.0))
@settings(max_examples=10, deadline=None)
def test_what_is_needed_is_what_the_loop_needs(seed, spacing):
    rng = np.random.default_rng(seed)
    xyz, views = sheet(rng, 60), views_of(rng, rng.integers(1, 7))
    order = rng.permutation(60)
    kept = np.zeros(60, bool)
    count = _places_in_views(xyz, views).keep(order, spacing, 60, kept)
    expected = slow.keep(xyz, views, order, spacing)
    assert sorted(expected) == np.flatnonzero(kept).tolist()
    assert count == len(expected)


@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(0, 300), st.integers(0, 4))
@settings(max_examples=40, deadline=None)
def test_exactly_so_many_are_kept(seed, num, first, num_views):
    rng = np.random.default_rng(seed)
    xyz = rng.choice([sheet(rng, 300), np.zeros((300, 3), np.float32)])
    xyz[rng.random(300) < 0.1] = np.nan
    kept = thin(xyz, views_of(rng, num_views), num, first=first, priority=rng.integers(0, 3, 300))
    assert kept.dtype == np.int64
    assert len(kept) == min(num, 300)
    assert (np.diff(kept) > 0).all()
    finite = np.isfinite(xyz[:, 0])
    if num_views == 0 and num <= finite.sum():
        assert finite[kept].all()  # what is nowhere comes last


def test_the_only_seed_of_a_cell_stays_before_the_second_of_another(rng):
    """A crowd of originals in one corner, and lone new points: all of these are kept."""
    view = slow.make_view(rng, 640, 480, 600, eye=(0, -1, 0))
    crowd = lattice(view, rng.uniform(0, 6, (500, 2)), 3.0)
    lone = lattice(view, [(8 + 8 * (k // 6), 8 + 8 * (k % 6)) for k in range(30)], 3.0)
    kept = thin(np.float32([*crowd, *lone]), [view], 60, first=500)
    assert set(range(500, 530)) <= set(kept.tolist())


def test_originals_alone_stay_dense_where_they_are_dense(rng):
    """A tenth of each part stays; what no view sees goes first."""
    view = slow.make_view(rng, 640, 480, 600, eye=(0, -1, 0))
    crowd = lattice(view, rng.uniform(0, 6, (900, 2)), 3.0)
    lone = lattice(view, rng.uniform(8, 60, (100, 2)), 3.0)
    behind = np.full((500, 3), -1e3)
    kept = thin(np.float32([*behind, *crowd, *lone]), [view], 100, first=1500)
    assert kept.min() >= 500
    assert np.count_nonzero(kept >= 1400) == 10


def test_one_point_far_away_does_not_thin_all_others_by_their_order(rng):
    xyz = np.sort(rng.random((5000, 3)).astype(np.float32), axis=0)
    xyz[0] = 1e9
    assert np.median(xyz[thin(xyz, (), 500)], axis=0) == pytest.approx(0.5, abs=0.1)


def test_originals_come_first_among_equals(rng):
    xyz = sheet(rng, 500)
    twice, views, high = np.concatenate([xyz, xyz]), views_of(rng, 3), np.arange(1000) >= 500
    assert (thin(twice, views, 100, first=500) < 500).all()
    assert (thin(twice, (), 100, first=500) < 500).all()
    assert (thin(twice, views, 100, priority=high) >= 500).all()
    assert (thin(twice, views, 100, first=500, priority=high) < 500).all()


ONE = [slow.make_view(np.random.default_rng(0))]
XYZ = np.zeros((9, 3), np.float32)


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda: thin(XYZ, ONE, 0), ParameterError),
        (lambda: thin(XYZ, ONE, 3, priority=np.zeros(8)), PointCloudError),
        (lambda: thin(XYZ[:, :2], ONE, 3), PointCloudError),
        (lambda: covered_share([], XYZ), ParameterError),
        (lambda: covered_share(ONE, XYZ, np.nan), ParameterError),
        (lambda: covered_share(ONE, XYZ[:, :2]), PointCloudError),
    ],
)
def test_bad_input_is_refused(call, error):
    with pytest.raises(error):
        call()
