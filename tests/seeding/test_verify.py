"""verify: points near a planted plane return to it, others are dropped, nothing is invented.

The plane goes through the world's origin, ``NORMAL`` towards the cameras; originals lie on it in
rows and columns, ``STEP`` metres apart. New points carry their numbers in their colours, so that
those that stay are known. Reference views and local geometry are compared with literal loops.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.methods.contract import NewPoints
from splatseed.photos.view import View
from splatseed.photos.visibility import Visibility
from splatseed.scene import Image
from splatseed.seeding import verify as module
from splatseed.seeding._kernels import verify as kernels
from splatseed.seeding.local_geometry import NEIGHBORS, LocalGeometry, local_geometry
from splatseed.synthetic.room import Room, render_view

from ..depth.stereo.made import DOWN, STONE, WIDTH, arc, tilted_plane
from .references import make_view, matrix_of, project

SETTINGS = module.SETTINGS
STEP = 0.12
ALONG = np.array([np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6)])
NORMAL = np.array([ALONG[2], 0.0, -ALONG[0]])
INNER = 0.45
"""Metres about the origin that all views see."""


def on_plane(places):
    """World positions of places in the plane, [N, 2] to [N, 3]."""
    return places[:, :1] * ALONG + places[:, 1:] * DOWN


KNOWN = on_plane(np.stack(np.meshgrid(*[STEP * np.arange(-5, 6)] * 2), axis=-1).reshape(-1, 2))
ROOM = Room(("plane",), tilted_plane(30.0), (STONE,))


@cache
def five_views():
    """Views of the plane, 96 x 80."""
    return [View(f"{k}", render_view(ROOM, c)[0], c) for k, c in enumerate(arc())]


@pytest.fixture
def places(rng):
    """Places in the plane, where all views see them."""
    return on_plane(rng.uniform(-INNER, INNER, (300, 2)))


def constant(view):
    """The same view of nothing but one grey."""
    return dataclasses.replace(view, photograph=np.full_like(view.photograph, 128))


def spacings(known, xyz):
    """Mean distance of each point's nearest original to the six nearest to that, [M]."""
    apart = np.linalg.norm(known[:, None] - known, axis=2)
    base = np.linalg.norm(xyz[:, None] - known, axis=2).argmin(axis=1)
    return np.sort(apart, axis=1)[base, 1:7].mean(axis=1)


def shifted(places, spacings_off):
    """Places moved off the plane by so many spacings, [M, 3]."""
    return places + (np.asarray(spacings_off) * spacings(KNOWN, places))[:, None] * NORMAL


def run_verify(views, known, new, seen=None):
    """``verify`` of new points [M, 3]; ``seen``: the originals of each view, by default all."""
    seen = [range(len(known))] * len(views) if seen is None else seen
    starts = np.cumsum([0, *map(len, seen)]).tolist()
    rows = np.array([row for each in seen for row in each], np.int64)
    counts = {k: len(each) for k, each in enumerate(seen)}
    visibility = Visibility(np.asarray(known, np.float64), rows, dict(enumerate(starts)), counts)
    images = []
    for k, view in enumerate(views):
        K, pose = view.K, view.cam_from_world
        params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        lens = Intrinsics(1, "PINHOLE", view.width, view.height, params)
        images.append(Image(view.name, k, lens, quat_from_rotation(pose[:3, :3]), pose[:3, 3]))
    return module.verify(views, images, visibility, numbered(new))


def numbered(xyz):
    """Points whose colours encode their numbers."""
    number = np.arange(len(xyz))
    rgb = np.stack([number % 256, number // 256, 0 * number], axis=1).astype(np.uint8)
    return NewPoints(np.asarray(xyz, np.float32), rgb, source=np.full(len(xyz), 4, np.uint8))


def numbers(points):
    """The numbers of the points that are left, [K]."""
    return points.rgb[:, 0].astype(int) + 256 * points.rgb[:, 1].astype(int)


def test_points_near_a_plane_slide_back_onto_it(places, rng):
    off = rng.uniform(0.3, 1.2, len(places)) * rng.choice([-1, 1], len(places))
    new = shifted(places, off)
    kept = run_verify(five_views(), KNOWN, new)
    assert len(kept.xyz) > 0.95 * len(new)
    before = np.abs(new[numbers(kept)] @ NORMAL) / spacings(KNOWN, new[numbers(kept)])
    after = np.abs(kept.xyz @ NORMAL) / spacings(KNOWN, new[numbers(kept)])
    assert before.min() > 0.29
    assert np.median(after) < 0.06
    assert np.percentile(after, 95) < 0.2
    assert np.median(kept.confidence) > 0.95
    np.testing.assert_allclose(kept.normals, np.tile(NORMAL, (len(kept.xyz), 1)), atol=1e-3)


def test_without_texture_flat_places_stay_and_others_are_dropped(places, rng):
    grey = [constant(view) for view in five_views()]
    flat = run_verify(grey, KNOWN, places)
    np.testing.assert_array_equal(flat.xyz, places.astype(np.float32))
    assert (flat.confidence == np.float32(SETTINGS.textureless_confidence)).all()
    rough = KNOWN + rng.normal(scale=0.3, size=(len(KNOWN), 3))
    assert len(run_verify(grey, rough, places).xyz) < 0.1 * len(places)


def test_points_that_no_pair_of_photographs_sees_stay_unchecked(places):
    beside = shifted(places, np.full(len(places), 0.8))
    half = len(KNOWN) // 2
    apart = [range(half), range(half, len(KNOWN))]
    dark = [dataclasses.replace(v, mask=np.zeros((v.height, v.width), bool)) for v in five_views()]
    for kept in (
        run_verify(five_views()[:1], KNOWN, beside),
        run_verify(five_views()[:2], KNOWN, beside, apart),
        run_verify([five_views()[0]] * 2, KNOWN, beside),
        run_verify(dark, KNOWN, beside),
        run_verify([], KNOWN, beside),
        run_verify(five_views(), KNOWN[:1], beside),
        run_verify(five_views(), KNOWN[:0], beside),
    ):
        np.testing.assert_array_equal(kept.xyz, beside.astype(np.float32))
        assert np.isnan(kept.confidence).all()
        assert f"{len(beside)}" in kept.notes[-1]


def test_mothers_pixels_drop_no_point(places):
    """Half of every photograph is mothers: points there stay, unchecked."""
    cut = []
    for view in five_views():
        mask = np.arange(view.width) < np.full((view.height, 1), view.width // 2)
        shown = view.photograph * mask[..., None]
        cut.append(dataclasses.replace(view, mask=mask, photograph=shown))
    far = np.concatenate([shifted(places, np.full(len(places), off)) for off in (-5.0, 5.0)])
    columns = np.array([v.camera.project(far)[0][:, 0] for v in five_views()])
    black, lit = (columns > WIDTH // 2).all(axis=0), (columns < WIDTH // 2 - 5).all(axis=0)
    assert min(black.sum(), lit.sum()) > 20
    kept = run_verify(cut, KNOWN, far)
    left = numbers(kept)
    assert black[left].sum() == black.sum()
    assert np.isnan(kept.confidence[black[left]]).all()
    assert lit[left].sum() < 0.1 * lit.sum()


SHAPES = {"apart": [1, 1, 1], "at one place": 0, "on a line": [1, 0, 0], "on a plane": [1, 1, 0]}


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 3),
    st.integers(0, 9),
    st.sampled_from(list(SHAPES)),
    st.sampled_from(["noise", "constant", "one of each"]),
)
@settings(max_examples=30, deadline=None)
def test_degenerate_input_gives_only_confirmed_points(seed, num_views, num_known, shape, look):
    rng = np.random.default_rng(seed)
    known = rng.normal(scale=0.2, size=(num_known, 3)) * SHAPES[shape]
    views = five_views()[:num_views]
    if look != "noise":
        views = [constant(v) if k or look == "constant" else v for k, v in enumerate(views)]
    new = rng.normal(scale=0.3, size=(rng.integers(0, 12), 3)).astype(np.float32)
    seen = [rng.permutation(num_known)[: rng.integers(num_known + 1)].tolist() for _ in views]
    known = np.unique(known, axis=0)
    kept = run_verify(
        views, known, new, [[row for row in each if row < len(known)] for each in seen]
    )
    left = numbers(kept)
    assert (np.diff(left) > 0).all()
    assert np.isfinite(kept.xyz).all()
    sure = kept.confidence > SETTINGS.textureless_confidence
    assert ((kept.confidence[sure] >= 1 - SETTINGS.max_cost) & (kept.confidence[sure] <= 1)).all()
    np.testing.assert_array_equal(kept.xyz[~sure], new[left[~sure]])
    if len(known) > 1:  # at most so many spacings along a normal of 73 degrees at most
        moved = np.linalg.norm(kept.xyz - new[left], axis=1)
        assert (moved <= kernels.MAX_MOVE / 0.29 * spacings(known, new[left]) + 1e-5).all()


GOOD, BAD, NONE = SETTINGS.max_cost - 0.3, SETTINGS.max_cost + 0.1, np.inf
RICH, POOR = 10 * SETTINGS.min_variance, 0.1 * SETTINGS.min_variance


@pytest.mark.parametrize(
    ("costs", "variances", "flat", "xyz", "confidence"),
    [
        ((GOOD, BAD), (RICH, RICH), False, 1, 1 - GOOD),
        ((BAD, GOOD), (RICH, RICH), False, 2, 1 - GOOD),
        ((-0.01, BAD), (RICH, RICH), False, 1, 1.0),
        ((GOOD, NONE), (RICH, 0.0), True, 1, 1 - GOOD),
        ((0.0, GOOD), (POOR, RICH), True, 2, 1 - GOOD),
        ((0.0, BAD), (POOR, RICH), True, None, None),
        ((BAD, NONE), (RICH, 0.0), True, None, None),
        ((GOOD, GOOD), (POOR, POOR), False, None, None),
        ((GOOD, NONE), (POOR, 0.0), True, 0, SETTINGS.textureless_confidence),
        ((NONE, NONE), (0.0, 0.0), False, 0, np.nan),
        ((NONE, NONE), (0.0, 0.0), True, 0, np.nan),
    ],
)
def test_the_outcome_of_a_point(costs, variances, flat, xyz, confidence):
    """For a point at 0 that two reference views move to (1, 1, 1) and (2, 2, 2)."""
    normal = np.array([[0.0, 0.0, 1.0]])
    geometry = LocalGeometry(np.zeros(1, int), np.ones(1), normal, np.array([flat]))
    put = np.array([[[1.0] * 3, [2.0] * 3]])
    found = module.PhotoChecks(
        *(np.array(e, np.float32) for e in (put, [[0, 0]], [costs], [variances]))
    )
    centers = np.array([[[0.0, 0.0, -3.0]] * 2])
    decided = module._apply_checks(numbered(np.zeros((1, 3))), geometry, found, centers)
    if xyz is None:
        assert len(decided.xyz) == 0
        return
    np.testing.assert_array_equal(decided.xyz, np.full((1, 3), xyz, np.float32))
    np.testing.assert_allclose(decided.confidence, [confidence], rtol=1e-6)
    if not np.isnan(confidence):
        np.testing.assert_array_equal(decided.normals, -normal)  # towards the reference view


def in_frame(view, point):
    """Whether a point falls into a view, away from its edge."""
    at = project(point, matrix_of(view, 1)[0])
    sizes = (view.width, view.height)
    return at is not None and all(
        kernels.MARGIN <= x <= s - kernels.MARGIN for x, s in zip(at, sizes, strict=False)
    )


def quality(view, point, normal):
    """How well a view sees a surface."""
    ray = point.astype(float) - view.camera.center
    distance = np.linalg.norm(ray)
    cosine = 0.0 if np.isnan(normal).any() else abs(ray @ normal) / distance
    return view.K[0, 0] * (cosine + kernels.OBLIQUE_WEIGHT) / distance


def reference_views_of(point, base, normal, views, seen, sources):
    """The views that check a point, best first."""
    able = []
    for k, view in enumerate(views):
        others = [j for j in sources[k] if j >= 0]
        inside = sum(in_frame(views[j], point) for j in others)
        enough = inside >= min(len(others), kernels.MIN_SOURCES) and inside > 0
        if base in seen[k] and in_frame(view, point) and enough:
            able.append((-quality(view, point, normal), k))
    best = [k for _, k in sorted(able)[: kernels.REFERENCE_VIEWS]]
    return best + [-1] * (kernels.REFERENCE_VIEWS - len(best))


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 3))
@settings(max_examples=30, deadline=None)
def test_reference_views_equal_the_loop(seed, num_views, num_sources):
    rng = np.random.default_rng(seed)
    views = [make_view(rng, *rng.integers(12, 60, 2).tolist()) for _ in range(num_views)]
    xyz = rng.normal(scale=0.7, size=(25, 3)).astype(np.float32)
    normals = rng.normal(size=(25, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::7] = np.nan
    seen = [np.flatnonzero(rng.random(8) < 0.7) for _ in views]
    sources = np.full((num_views, num_sources), -1)
    for k in range(num_views):
        others = rng.permutation(np.delete(np.arange(num_views), k))[:num_sources]
        sources[k, : len(others)] = others
    base = rng.integers(0, 8, 25)
    geometry = LocalGeometry(base, np.ones(25), normals, np.ones(25, bool))
    found = module.choose_reference_views(xyz, geometry, views, seen, 8, sources)
    expected = [
        reference_views_of(point, b, n, views, seen, sources.tolist())
        for point, b, n in zip(xyz, base, normals, strict=True)
    ]
    np.testing.assert_array_equal(found, expected)


def test_local_geometry_equals_the_loop(rng):
    known = rng.normal(size=(60, 3)).astype(np.float32).astype(float)
    xyz = rng.normal(size=(40, 3)).astype(np.float32)
    geometry = local_geometry(known, xyz)
    for i, point in enumerate(xyz):
        base = int(np.argmin([math.dist(point, each) for each in known]))
        assert geometry.base[i] == base
        near = known[np.argsort([math.dist(known[base], each) for each in known])]
        apart = [math.dist(known[base], each) for each in near[1:7]]
        assert geometry.spacing[i] == pytest.approx(np.mean(apart))
        axes = np.linalg.eigh(np.cov(near[: NEIGHBORS + 1].T))[1]
        assert abs(axes[:, 0] @ geometry.normals[i]) == pytest.approx(1.0, abs=1e-6)
