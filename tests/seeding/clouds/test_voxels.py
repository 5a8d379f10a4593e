"""Voxels against a literal reference: groups of points by level and place."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.seeding.clouds.judging import find_support
from splatseed.seeding.clouds.voxels import ASIDE, Voxels
from splatseed.views.view import View


def view(center, focal=50.0):
    """40 x 30 pixels, looking along z."""
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(center, float)
    K = np.array([[focal, 0, 20], [0, focal, 15], [0, 0, 1.0]])
    return View("", np.empty((0, 0, 3), np.uint8), K, 40, 30, pose)


VIEWS = [view((0, 0, 0)), view((0.3, 0.1, -2), 80.0)]


def reference(xyz, rgb, pixels):
    """Mean positions and colours of the points of each voxel, by a loop."""
    groups = defaultdict(list)
    for i, point in enumerate(xyz):
        least = np.inf
        for each in VIEWS:
            cam = each.cam_from_world[:3, :3] @ point + each.cam_from_world[:3, 3]
            u, v, _ = each.K @ cam / cam[2]
            if cam[2] > 0 and 0 <= u < 40 and 0 <= v < 30:
                least = min(least, pixels * cam[2] / each.K[0, 0])
        if least < np.inf:
            level = int(np.floor(np.log2(least)))
            groups[level, *np.floor((point + ASIDE) / 2.0**level).astype(int)].append(i)
    mean = np.array([xyz[which].mean(axis=0) for which in groups.values()])
    color = np.array([rgb[which].mean(axis=0) for which in groups.values()])
    return mean, np.rint(color), np.array([len(which) for which in groups.values()])


@pytest.fixture
def points(rng):
    return rng.uniform((-2, -2, -1), (2, 2, 6), (3000, 3)), rng.integers(
        0, 256, (3000, 3), np.uint8
    )


def test_voxels_hold_the_means_of_their_points(points):
    xyz, rgb = points
    voxels = Voxels(4096, VIEWS, 3.0)
    voxels.add(xyz, rgb)
    mean, color, count = reference(xyz, rgb, 3.0)
    assert len(voxels) == len(mean)
    assert voxels.coarser == 0
    np.testing.assert_allclose(voxels.xyz, mean, atol=1e-5)
    assert np.abs(voxels.rgb - color).max() <= 1
    np.testing.assert_array_equal(voxels.count, count)
    assert voxels.unseen == len(xyz) - count.sum() > 0


@settings(max_examples=15, deadline=None)
@given(size=st.integers(1, 3000), capacity=st.integers(20, 2000))
def test_chunks_do_not_matter_and_no_point_is_lost(size, capacity):
    rng = np.random.default_rng(1)
    xyz = rng.uniform((-1, -1, 1), (1, 1, 6), (2000, 3))
    rgb = rng.integers(0, 256, (2000, 3), np.uint8)
    whole, parts = Voxels(capacity, VIEWS, 2.0), Voxels(capacity, VIEWS, 2.0)
    whole.add(xyz, rgb)
    for start in range(0, len(xyz), size):
        parts.add(xyz[start : start + size], rgb[start : start + size])
    assert len(whole) <= capacity
    assert whole.count.sum() + whole.unseen == len(xyz)
    for name in ("xyz", "rgb", "count", "side"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


def test_even_voxels_fit_their_capacity_at_the_smallest_side(rng):
    xyz = rng.uniform(-5, 5, (20000, 3))
    xyz[:, 2] = 0
    voxels = Voxels(1000)
    voxels.add(xyz[:10])
    voxels.add(xyz[10:])
    assert 250 <= len(voxels) <= 1000
    cells = np.floor((voxels.xyz + ASIDE) / voxels.side[0])
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_support_counts_the_points_around(rng):
    xyz = rng.uniform(-2, 2, (400, 3)).astype(np.float32)
    side = np.where(rng.random(400) < 0.5, 0.25, 0.5).astype(np.float32)
    count = rng.integers(1, 9, 400).astype(np.int32)
    cells = np.floor(xyz / (2 * side[:, None]))
    near = (np.abs(cells[:, None] - cells) <= 1).all(axis=2) & (side[:, None] == side)
    np.testing.assert_array_equal(find_support(xyz, side, count), near @ count)
