"""Voxels against points grouped by level and place in a loop."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from hypothesis import given, settings, strategies as st

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.seeding.clouds._kernels import VOXEL_ORIGIN
from splatseed.seeding.clouds.voxels import Voxels


def view(center, focal, width, height, shade=0):
    """Looking along z, at one grey."""
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(center, float)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return View("", np.full((height, width, 3), shade, np.uint8), Camera(K, width, height, pose))


TWO = [view((0, 0, 0), 50.0, 40, 30), view((0.3, 0.1, -2), 80.0, 40, 30)]


def reference(xyz, rgb, pixels):
    """Mean positions and colours of the points of each voxel, by a loop."""
    groups = defaultdict(list)
    for i, point in enumerate(xyz):
        smallest = np.inf
        for each in TWO:
            cam = each.cam_from_world[:3, :3] @ point + each.cam_from_world[:3, 3]
            u, v, _ = each.K @ cam / cam[2]
            if cam[2] > 0 and 0 <= u < 40 and 0 <= v < 30:
                smallest = min(smallest, pixels * cam[2] / each.K[0, 0])
        if smallest < np.inf:
            level = int(np.floor(np.log2(smallest)))
            groups[level, *np.floor((point + VOXEL_ORIGIN) / 2.0**level).astype(int)].append(i)
    mean = np.array([xyz[which].mean(axis=0) for which in groups.values()])
    color = np.array([rgb[which].mean(axis=0) for which in groups.values()])
    return mean, np.rint(color), np.array([len(which) for which in groups.values()])


def test_voxels_hold_the_means_of_their_points(rng):
    xyz = rng.uniform((-2, -2, -1), (2, 2, 6), (3000, 3))
    rgb = rng.integers(0, 256, (3000, 3), np.uint8)
    voxels = Voxels(4096, TWO, 3.0)
    voxels.add(xyz, rgb)
    mean, color, count = reference(xyz, rgb, 3.0)
    assert len(voxels) == len(mean)
    assert voxels.coarsening == 0
    np.testing.assert_allclose(voxels.xyz, mean, atol=1e-5)
    assert np.abs(voxels.rgb - color).max() <= 1
    np.testing.assert_array_equal(voxels.count, count)
    assert voxels.num_outside == len(xyz) - count.sum() > 0


@settings(max_examples=8, deadline=None)
@given(size=st.integers(1, 3000), capacity=st.integers(20, 2000))
def test_chunks_do_not_matter_and_no_point_is_lost(size, capacity):
    rng = np.random.default_rng(1)
    xyz = rng.uniform((-1, -1, 1), (1, 1, 6), (2000, 3))
    rgb = rng.integers(0, 256, (2000, 3), np.uint8)
    whole, parts = Voxels(capacity, TWO, 2.0), Voxels(capacity, TWO, 2.0)
    whole.add(xyz, rgb)
    for start in range(0, len(xyz), size):
        parts.add(xyz[start : start + size], rgb[start : start + size])
    assert len(whole) <= capacity
    assert whole.count.sum() + whole.num_outside == len(xyz)
    for name in ("xyz", "rgb", "count", "side"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


def test_even_voxels_fit_their_capacity_at_the_smallest_side(rng):
    xyz = rng.uniform(-5, 5, (20000, 3)) * (1, 1, 0)
    voxels = Voxels(1000)
    voxels.add(xyz[:10])
    voxels.add(xyz[10:])
    assert 250 <= len(voxels) <= 1000
    cells = np.floor((voxels.xyz + VOXEL_ORIGIN) / voxels.side[0])
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_black_points_have_no_colour():
    xyz = np.array([[0.1, 0.1, 3.0], [0.1, 0.1, 3.0], [0.1, 0.1, 3.0], [0.9, 0.1, 3.0]])
    rgb = np.array([[10, 20, 30], [0, 0, 0], [20, 40, 50], [0, 0, 0]], np.uint8)
    voxels = Voxels(64)
    voxels.add(xyz, rgb)
    assert voxels.count.tolist() == [3, 1]
    assert voxels.rgb.tolist() == [[15, 30, 40], [0, 0, 0]]
    assert voxels.has_color.tolist() == [True, False]
