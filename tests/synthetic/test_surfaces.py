"""Every surface: distance, samples and rays must agree with each other and with brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatseed.synthetic import SHAPES
from splatseed.synthetic.surfaces import Box, Discs, SineSheet, yaw_frame


def _discs() -> Discs:
    rng = np.random.default_rng(5)
    axes = rng.normal(size=(12, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return Discs(rng.uniform(-0.7, 0.7, (12, 3)), axes, rng.uniform(0.1, 0.4, 12))


MAKERS = {
    **SHAPES,
    "box": lambda: Box(np.array([0.1, -0.2, 0.3]), np.array([0.4, 0.3, 0.6]), yaw_frame(25)),
    "discs": _discs,
}


@pytest.fixture(params=sorted(MAKERS))
def surface(request):
    return MAKERS[request.param]()


def test_distance_agrees_with_a_dense_sampling(surface, rng):
    points = rng.uniform(-1.6, 1.6, (3000, 3))
    samples = surface.sample(40_000, rng)
    brute, _ = cKDTree(samples).query(points)
    gap = np.sqrt(surface.area / len(samples))
    exact = surface.distance(points)
    assert (exact <= brute + 1e-9).all()  # no sample may be nearer than the surface
    assert (brute - exact).max() < 6 * gap  # and the dense samples come near it everywhere


def test_samples_lie_on_the_surface_uniform_by_area(surface, rng):
    samples = surface.sample(60_000, rng)
    assert surface.distance(samples).max() < 1e-9
    centers = samples[:40]
    # Around interior points the density is samples per area; edges can only lower the count.
    radius = 0.08
    counts = np.array([len(hit) for hit in cKDTree(samples).query_ball_point(centers, radius)])
    expected = len(samples) * np.pi * radius**2 / surface.area
    assert 0.7 < np.percentile(counts, 75) / expected < 2.1


def test_rays_stop_at_the_first_surface(surface, rng):
    origin = np.array([2.5, 1.7, 2.1])
    directions = surface.sample(1500, rng) - origin
    t = surface.intersect(origin, directions)
    # A ray may pass through a sliver of a sine sheet's crest unnoticed: its sample is behind.
    assert (t <= 1 + 1e-9).mean() > (0.98 if isinstance(surface, SineSheet) else 0.9999)
    hit = t[np.isfinite(t), None] * directions[np.isfinite(t)] + origin
    assert surface.distance(hit).max() < 1e-9
    # Nothing lies between: walking along each ray, the surface stays away until the hit.
    for share in (0.25, 0.5, 0.75, 0.9):
        before = t[np.isfinite(t), None] * share * directions[np.isfinite(t)] + origin
        assert (surface.distance(before) > 1e-6).all()
    assert np.isinf(surface.intersect(origin, np.array([[1.0, 0, 0], [0.5, 1, 0.3]]))).all()  # away


def test_normals_are_unit_and_across_the_surface(surface, rng):
    points = surface.sample(800, rng)
    normals = surface.normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    step = 1e-4
    rise = np.minimum(
        surface.distance(points + step * normals), surface.distance(points - step * normals)
    )
    assert np.median(rise) == pytest.approx(step, rel=1e-2)
