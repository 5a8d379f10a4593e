"""Budgets: numbers, and which points are kept of too many."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.errors import ParameterError, PointCloudError
from splatseed.seeding.budget import _places_in_views, thin
from splatseed.seeding.coverage import covered_share

from . import references as slow


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


def test_thinning_leaves_the_picture_covered(rng):
    xyz, views = sheet(rng, 20_000), views_of(rng, 6)
    chance = rng.choice(len(xyz), 1200, replace=False)
    kept = thin(xyz, views, 1200)
    ours, whole = covered_share(views, xyz[kept], 3), covered_share(views, xyz, 3)
    assert ours > 0.85 * whole
    assert ours > covered_share(views, xyz[chance], 3) + 0.1 * whole


def test_the_only_seed_of_a_cell_stays_before_the_second_of_another(rng):
    """A crowd of originals in one corner, and lone new points: all of these are kept."""
    view = slow.make_view(rng, 640, 480, 600, eye=(0, -1, 0))
    crowd = [slow.lift(view, 8, *rng.uniform(0, 6, 2), 3.0) for _ in range(500)]
    i, j = np.divmod(np.arange(30), 6)
    lone = [slow.lift(view, 8, 8 + 8 * a, 8 + 8 * b, 3.0) for a, b in zip(i, j, strict=True)]
    kept = thin(np.float32([*crowd, *lone]), [view], 60, first=500)
    assert set(range(500, 530)) <= set(kept.tolist())


def test_originals_come_first_among_equals(rng):
    xyz = sheet(rng, 500)
    twice = np.concatenate([xyz, xyz])
    assert (thin(twice, views_of(rng, 3), 100, first=500) < 500).all()
    assert (thin(twice, (), 100, first=500) < 500).all()
    high = np.arange(1000) >= 500
    assert (thin(twice, views_of(rng, 3), 100, priority=high) >= 500).all()
    assert (thin(twice, views_of(rng, 3), 100, first=500, priority=high) < 500).all()


def test_threads_change_nothing(rng):
    xyz, views = sheet(rng, 3000), views_of(rng, 5)
    most, found = numba.get_num_threads(), []
    for threads in (1, most):
        numba.set_num_threads(threads)
        found.append(thin(xyz, views, 700, first=1000).tolist())
    numba.set_num_threads(most)
    assert found[0] == found[1]


def test_bad_input_is_refused(rng):
    xyz, views = sheet(rng, 9), views_of(rng, 1)
    with pytest.raises(ParameterError, match="at least 1 point"):
        thin(xyz, views, 0)
    with pytest.raises(PointCloudError, match=r"priority of shape \[9\]"):
        thin(xyz, views, 3, priority=np.zeros(8))
    for given_views in (views, ()):
        with pytest.raises(PointCloudError, match=r"\[N, 3\]"):
            thin(xyz[:, :2], given_views, 3)
