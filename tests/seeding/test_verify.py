"""verify: points beside a planted plane go back onto it, points far from it go, nothing is made
up."""

from __future__ import annotations

import dataclasses
import os

import numba
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.seeding.sliding import REACH
from splatseed.seeding.verify import (
    BARE_CONFIDENCE,
    MAX_COST,
    TEXTURE,
    Surroundings,
    _decide,
    _Trials,
)

from ..depth.stereo.made import WIDTH
from .planted import (
    NORMAL,
    constant,
    hold,
    numbered,
    numbers,
    on_plane,
    originals,
    photographs,
    spacings,
)

KNOWN = originals()
INNER = 0.45
"""Metres about the origin that all views see."""


@pytest.fixture(scope="module")
def views():
    return photographs()


@pytest.fixture
def places(rng):
    """Places in the plane, where all views see them."""
    return on_plane(rng.uniform(-INNER, INNER, (300, 2)))


def shifted(places, spacings_off):
    """Places moved off the plane by so many spacings, [M, 3]."""
    return places + (np.asarray(spacings_off) * spacings(KNOWN, places))[:, None] * NORMAL


def project(view, xyz):
    """Pixels of points, [M, 2]."""
    cam = xyz @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    return (cam @ view.K.T)[:, :2] / cam[:, 2:]


def test_points_beside_a_plane_slide_back_onto_it(views, places, rng):
    off = rng.uniform(0.3, 1.2, len(places)) * rng.choice([-1, 1], len(places))
    new = shifted(places, off)
    kept = hold(views, KNOWN, new)
    assert len(kept.xyz) > 0.95 * len(new)
    before = np.abs(new[numbers(kept)] @ NORMAL) / spacings(KNOWN, new[numbers(kept)])
    after = np.abs(kept.xyz @ NORMAL) / spacings(KNOWN, new[numbers(kept)])
    assert before.min() > 0.29
    assert np.median(after) < 0.06
    assert np.percentile(after, 95) < 0.2
    assert np.median(kept.confidence) > 0.95
    np.testing.assert_allclose(kept.normals, np.tile(NORMAL, (len(kept.xyz), 1)), atol=1e-3)


@pytest.mark.parametrize("spacings_off", [-6.0, 5.0])
def test_points_far_from_the_surface_are_dropped(spacings_off, views, places):
    new = shifted(places, np.full(len(places), spacings_off))
    assert len(hold(views, KNOWN, new).xyz) < 0.1 * len(new)


def test_without_texture_flat_places_stay_and_others_go(views, places, rng):
    grey = [constant(view) for view in views]
    flat = hold(grey, KNOWN, places)
    np.testing.assert_array_equal(flat.xyz, places.astype(np.float32))
    assert (flat.confidence == np.float32(BARE_CONFIDENCE)).all()
    rough = KNOWN + rng.normal(scale=0.3, size=(len(KNOWN), 3))
    assert len(hold(grey, rough, places).xyz) < 0.1 * len(places)


def test_what_no_pair_of_photographs_sees_is_kept_unchecked(views, places):
    beside = shifted(places, np.full(len(places), 0.8))
    half = len(KNOWN) // 2
    apart = [range(half), range(half, len(KNOWN))]
    dark = [dataclasses.replace(v, mask=np.zeros((v.height, v.width), bool)) for v in views]
    results = [
        hold(views[:1], KNOWN, beside),
        hold(views[:2], KNOWN, beside, apart),
        hold([views[0]] * 2, KNOWN, beside),
        hold(dark, KNOWN, beside),
        hold([], KNOWN, beside),
        hold(views, KNOWN[:1], beside),
        hold(views, KNOWN[:0], beside),
    ]
    for kept in results:
        np.testing.assert_array_equal(kept.xyz, beside.astype(np.float32))
        assert np.isnan(kept.confidence).all()
        assert "unchecked" in kept.notes[-1]


def test_of_a_photograph_only_what_it_shows_judges(views, places):
    """The half that is black tells nothing: points there are not dropped for it."""
    cut = []
    for view in views:
        mask = np.arange(view.width) < np.full((view.height, 1), view.width // 2)
        cut.append(
            dataclasses.replace(view, mask=mask, photograph=view.photograph * mask[..., None])
        )
    far = np.concatenate([shifted(places, np.full(len(places), off)) for off in (-5.0, 5.0)])
    columns = np.array([project(v, far)[:, 0] for v in views])
    black, lit = (columns > WIDTH // 2).all(axis=0), (columns < WIDTH // 2 - 5).all(axis=0)
    assert min(black.sum(), lit.sum()) > 20
    kept = hold(cut, KNOWN, far)
    left = numbers(kept)
    assert black[left].sum() == black.sum()
    assert np.isnan(kept.confidence[black[left]]).all()
    assert lit[left].sum() < 0.1 * lit.sum()


def test_one_and_two_threads_give_the_same_bytes(views, places, rng, monkeypatch):
    new = shifted(places, rng.uniform(-3, 3, len(places)))
    first, threads = hold(views, KNOWN, new), numba.get_num_threads()
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    numba.set_num_threads(1)
    try:
        second = hold(views, KNOWN, new)
    finally:
        numba.set_num_threads(threads)
    assert 0 < len(first.xyz) < len(new)
    for one, other in zip(first, second, strict=True):
        same = one == other if isinstance(one, tuple) or one is None else None
        assert same or one.tobytes() == other.tobytes()


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 3),
    st.integers(0, 9),
    st.sampled_from(["apart", "at one place", "on a line", "on a plane"]),
    st.sampled_from(["noise", "constant", "one of each"]),
)
@settings(max_examples=30, deadline=None)
def test_nothing_is_made_up_from_degenerate_input(seed, num_views, num_known, shape, look):
    rng = np.random.default_rng(seed)
    known = rng.normal(scale=0.2, size=(num_known, 3))
    known *= {
        "apart": [1, 1, 1],
        "at one place": 0,
        "on a line": [1, 0, 0],
        "on a plane": [1, 1, 0],
    }[shape]
    views = MANY[:num_views]
    if look != "noise":
        views = [constant(v) if k or look == "constant" else v for k, v in enumerate(views)]
    new = rng.normal(scale=0.3, size=(rng.integers(0, 12), 3)).astype(np.float32)
    seen = [rng.permutation(num_known)[: rng.integers(num_known + 1)].tolist() for _ in views]
    known = np.unique(known, axis=0)
    kept = hold(views, known, new, [[row for row in each if row < len(known)] for each in seen])
    left = numbers(kept)
    assert (np.diff(left) > 0).all()
    assert np.isfinite(kept.xyz).all()
    sure = kept.confidence > BARE_CONFIDENCE
    assert ((kept.confidence[sure] >= 1 - MAX_COST) & (kept.confidence[sure] <= 1)).all()
    np.testing.assert_array_equal(kept.xyz[~sure], new[left[~sure]])
    if len(known) > 1:  # at most REACH spacings along a normal that is not steeper than 73 degrees
        moved = np.linalg.norm(kept.xyz - new[left], axis=1)
        assert (moved <= REACH / 0.29 * spacings(known, new[left]) + 1e-5).all()


MANY = photographs()


def trials(costs, variances, moves=0.0):
    """What two judges found of one point, which they put at (1, 1, 1) and (2, 2, 2)."""
    return _Trials(
        np.array([[[1.0] * 3, [2.0] * 3]], np.float32),
        np.full((1, 2), moves, np.float32),
        np.array([costs], np.float32),
        np.array([variances], np.float32),
    )


GOOD, BAD, NONE = MAX_COST - 0.3, MAX_COST + 0.1, np.inf
RICH, BARE = 10 * TEXTURE, 0.1 * TEXTURE


@pytest.mark.parametrize(
    ("costs", "variances", "flat", "xyz", "confidence"),
    [
        ((GOOD, BAD), (RICH, RICH), False, 1, 1 - GOOD),
        ((BAD, GOOD), (RICH, RICH), False, 2, 1 - GOOD),
        ((-0.01, BAD), (RICH, RICH), False, 1, 1.0),
        ((GOOD, NONE), (RICH, 0.0), True, 1, 1 - GOOD),
        ((0.0, GOOD), (BARE, RICH), True, 2, 1 - GOOD),
        ((0.0, BAD), (BARE, RICH), True, None, None),
        ((BAD, NONE), (RICH, 0.0), True, None, None),
        ((GOOD, GOOD), (BARE, BARE), False, None, None),
        ((GOOD, NONE), (BARE, 0.0), True, 0, BARE_CONFIDENCE),
        ((NONE, NONE), (0.0, 0.0), False, 0, np.nan),
        ((NONE, NONE), (0.0, 0.0), True, 0, np.nan),
    ],
)
def test_the_fate_of_a_point(costs, variances, flat, xyz, confidence):
    normal = np.array([[0.0, 0.0, 1.0]])
    around = Surroundings(np.zeros(1, int), np.ones(1), normal, np.array([flat]))
    centers = np.array([[[0.0, 0.0, -3.0]] * 2])
    decided = _decide(numbered(np.zeros((1, 3))), around, trials(costs, variances), centers)
    if xyz is None:
        assert len(decided.xyz) == 0
        return
    np.testing.assert_array_equal(decided.xyz, np.full((1, 3), xyz, np.float32))
    np.testing.assert_allclose(decided.confidence, [confidence], rtol=1e-6)
    if not np.isnan(confidence):
        np.testing.assert_array_equal(decided.normals, -normal)  # towards the judge
