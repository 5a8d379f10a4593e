"""Where new points fall: uniform wherever the paper or our own text says so.

Every test counts draws in cells of equal area or volume, or compares with a uniform distribution;
p-values below 1e-3 fail, with fixed seeds.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy

import splatseed as ss
from splatseed.methods.neighbors import draw_bases, prepare
from splatseed.methods.patches import place_in_box, place_in_triangle, place_on_disc

NUM = 20_000


def assert_uniform(values):
    assert scipy.stats.kstest(values, "uniform").pvalue > 1e-3


def new_points(xyz, method, **options):
    xyz = np.asarray(xyz, np.float32)
    rgb = np.zeros(xyz.shape, np.uint8)
    rgb[0] = 255
    more = ss.upsample(ss.PointCloud(xyz, rgb), method, num_points=len(xyz) + NUM, **options)
    return more.xyz[len(xyz) :].astype(np.float64), more.rgb[len(xyz) :].astype(np.float64)


@pytest.fixture
def one_base():
    """A base at the origin with neighbours at distance 1, 2, ... 12 around it, and its frame."""
    angle = np.arange(12)
    around = (1.0 + angle)[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    xyz = np.concatenate([np.zeros((1, 3)), around])
    cloud = prepare(ss.PointCloud(xyz.astype(np.float32), np.zeros(xyz.shape, np.uint8)))
    neighbors = cloud.neighbors(12)
    base = np.flatnonzero(cloud.rank == 0)[0]
    weight = np.zeros(len(xyz))
    weight[base] = 1.0
    bases = draw_bases(cloud, NUM, np.random.default_rng(1), weight=weight)
    frames = np.tile(np.eye(3), (len(xyz), 1, 1))
    return cloud, neighbors, bases, frames


def test_linear_is_uniform_on_the_segment():
    xyz, rgb = new_points([[0, 0, 0], [2, 4, 6]], "linear")
    assert_uniform(xyz[:, 0] / 2)
    np.testing.assert_allclose(xyz, xyz[:, :1] * [1, 2, 3], atol=1e-6)
    # Red falls from 255 to 0 along the segment, in step with the position.
    assert np.abs(rgb[:, 0] - 255 * (1 - xyz[:, 0] / 2)).max() <= 0.501


def test_triangle_is_uniform_in_the_triangle():
    xyz, rgb = new_points([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "triangle")
    x, y = xyz[:, 0], xyz[:, 1]
    # P(x + y < t) = t^2, and y / (x + y) is uniform and independent of it.
    assert_uniform((x + y) ** 2)
    assert_uniform(y / (x + y))
    assert scipy.stats.spearmanr(x + y, y / (x + y)).pvalue > 1e-3
    assert np.abs(rgb[:, 0] - 255 * (1 - x - y)).max() <= 0.501


def test_places_on_a_patch(one_base, rng):
    cloud, neighbors, bases, frames = one_base
    flat = np.zeros(len(neighbors.idx), bool)
    u, v = place_on_disc(neighbors, bases, flat, 1.5, rng).astype(np.float64).T
    assert_uniform((u**2 + v**2) / (1.5 * 3.5) ** 2)  # h: the mean of the 6 nearest
    assert_uniform((np.arctan2(v, u) / (2 * np.pi)) % 1.0)
    uv = place_in_box(cloud, neighbors, bases, frames, rng).astype(np.float64)
    low, high = cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)
    for axis in (uv + cloud.xyz[cloud.rank == 0, :2] - low).T / (high - low)[:, None]:
        assert_uniform(axis)
    # Every pair of the eight nearest spans a triangle with the base.
    uv = place_in_triangle(cloud, neighbors, bases, frames, rng).astype(np.float64)
    mean = 2 / 3 * np.mean([(r * np.cos(r - 1), r * np.sin(r - 1)) for r in range(1, 9)], axis=0)
    assert (np.abs(uv.mean(axis=0) - mean) < 4 * uv.std(axis=0) / np.sqrt(NUM)).all()
    assert 7.0 < np.linalg.norm(uv, axis=1).max() < 8.0


def test_voronoi_is_uniform_in_the_ball_of_a_cell():
    # Among the points of a lattice all but the middle one are out of the draw, by their weight.
    lattice = np.stack(np.meshgrid(*[np.arange(-2.0, 3.0)] * 3), axis=-1).reshape(-1, 3)
    xyz, _ = new_points(lattice, "voronoi", k=40)
    near = xyz[np.abs(xyz).max(axis=1) < 0.5]
    radius = 0.5 * np.sqrt(0.75)  # half the way to the unit cube's corners
    length = np.linalg.norm(near, axis=1)
    assert len(near) > 50
    assert length.max() <= radius * (1 + 1e-6)
    assert_uniform((length / radius) ** 3)
    assert_uniform((near[:, 0] / length + 1) / 2)


def test_random_is_uniform_in_the_bounding_box_with_the_originals_colors(rng):
    cloud = rng.random((50, 3)) * [1.0, 2.0, 3.0]
    xyz, rgb = new_points(cloud, "random")
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    for axis in ((xyz - low) / (high - low)).T:
        assert_uniform(axis)
    assert scipy.stats.binomtest(int((rgb[:, 0] == 255).sum()), NUM, 1 / 50).pvalue > 1e-3
