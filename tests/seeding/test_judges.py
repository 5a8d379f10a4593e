"""Who judges a new point, and what is known of its surroundings, held to literal loops."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.seeding.verify import (
    MARGIN,
    NEIGHBORS,
    OBLIQUE,
    REFERENCE_VIEWS,
    WITNESSES,
    Surroundings,
    choose_reference_views,
    survey,
)

from .references import make_view, matrix_of, project


def holds(view, point):
    """Whether a point falls into a view, away from its edge."""
    at = project(point, matrix_of(view, 1)[0])
    return (
        at is not None
        and MARGIN <= at[0] <= view.width - MARGIN
        and MARGIN <= at[1] <= view.height - MARGIN
    )


def worth(view, point, normal):
    """How well a view sees a surface."""
    center = -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
    ray = point.astype(float) - center
    distance = np.linalg.norm(ray)
    cosine = 0.0 if np.isnan(normal).any() else abs(ray @ normal) / distance
    return view.K[0, 0] * (cosine + OBLIQUE) / distance


def judges_of(point, base, normal, views, seen, sources):
    """The views that judge a point, best first."""
    able = []
    for k, view in enumerate(views):
        asked = [j for j in sources[k] if j >= 0]
        holding = sum(holds(views[j], point) for j in asked)
        enough = holding >= min(len(asked), WITNESSES) and holding > 0
        if base in seen[k] and holds(view, point) and enough:
            able.append((-worth(view, point, normal), k))
    best = [k for _, k in sorted(able)[:REFERENCE_VIEWS]]
    return best + [-1] * (REFERENCE_VIEWS - len(best))


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 3))
@settings(max_examples=30, deadline=None)
def test_judges_are_those_of_the_loop(seed, num_views, num_sources):
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
    around = Surroundings(base, np.ones(25), normals, np.ones(25, bool))
    found = choose_reference_views(xyz, around, views, seen, 8, sources)
    expected = [
        judges_of(point, b, n, views, seen, sources.tolist())
        for point, b, n in zip(xyz, base, normals, strict=True)
    ]
    np.testing.assert_array_equal(found, expected)


def test_surroundings_are_those_of_the_loop(rng):
    known = rng.normal(size=(60, 3)).astype(np.float32).astype(float)
    xyz = rng.normal(size=(40, 3)).astype(np.float32)
    around = survey(known, xyz)
    for i, point in enumerate(xyz):
        distance = [math.dist(point, each) for each in known]
        base = int(np.argmin(distance))
        assert around.base[i] == base
        order = np.argsort([math.dist(known[base], each) for each in known])
        near = known[order]
        apart = [math.dist(known[base], each) for each in near[1:7]]
        assert around.spacing[i] == pytest.approx(np.mean(apart))
        spread, axes = np.linalg.eigh(np.cov(near[: NEIGHBORS + 1].T))
        assert spread[0] < spread[1]
        assert abs(axes[:, 0] @ around.normals[i]) == pytest.approx(1.0, abs=1e-6)


def test_planes_are_flat_and_clouds_are_not(rng):
    cloud = rng.normal(size=(300, 3))
    plane = cloud * [1, 1, 0.02]
    line = np.linspace(-1, 1, 30)[:, None] * [1.0, 2.0, 3.0]
    assert survey(plane, plane[:50].astype(np.float32)).flat.mean() > 0.95
    assert survey(cloud, cloud[:50].astype(np.float32)).flat.mean() < 0.2
    beside = survey(line, line.astype(np.float32))
    assert not beside.flat.any()
    assert np.isnan(beside.normals).all()
