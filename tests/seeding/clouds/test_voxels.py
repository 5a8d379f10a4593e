"""Voxels against groups of points by level and place; and what photographs see of a cloud."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.photos.view import View
from splatseed.progress import silent
from splatseed.seeding.clouds import judging as module
from splatseed.seeding.clouds.judging import find_evidence, find_support, find_surfaces, free_rays
from splatseed.seeding.clouds.voxels import ASIDE, Voxels


def view(center, focal, width, height, shade=0):
    """Looking along z, at one grey."""
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(center, float)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return View("", np.full((height, width, 3), shade, np.uint8), K, width, height, pose)


TWO = [view((0, 0, 0), 50.0, 40, 30), view((0.3, 0.1, -2), 80.0, 40, 30)]


def reference(xyz, rgb, pixels):
    """Mean positions and colours of the points of each voxel, by a loop."""
    groups = defaultdict(list)
    for i, point in enumerate(xyz):
        least = np.inf
        for each in TWO:
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


def test_voxels_hold_the_means_of_their_points(rng):
    xyz = rng.uniform((-2, -2, -1), (2, 2, 6), (3000, 3))
    rgb = rng.integers(0, 256, (3000, 3), np.uint8)
    voxels = Voxels(4096, TWO, 3.0)
    voxels.add(xyz, rgb)
    mean, color, count = reference(xyz, rgb, 3.0)
    assert len(voxels) == len(mean)
    assert voxels.coarser == 0
    np.testing.assert_allclose(voxels.xyz, mean, atol=1e-5)
    assert np.abs(voxels.rgb - color).max() <= 1
    np.testing.assert_array_equal(voxels.count, count)
    assert voxels.unseen == len(xyz) - count.sum() > 0


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
    assert whole.count.sum() + whole.unseen == len(xyz)
    for name in ("xyz", "rgb", "count", "side"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


def test_even_voxels_fit_their_capacity_at_the_smallest_side(rng):
    xyz = rng.uniform(-5, 5, (20000, 3)) * (1, 1, 0)
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


W, H, F = 64, 48, 60.0
VIEWS = [
    view((x, 0, 0), F, W, H, grey) for x, grey in ((-0.5, 100), (0, 104), (0.5, 96), (0.2, 250))
]


@pytest.fixture
def wall(rng):
    """A wall at depth 4, points at about every pixel."""
    xy = rng.uniform((-2.5, -1.6), (2.5, 1.6), (40000, 2))
    return np.column_stack([xy, np.full(len(xy), 4.0)]).astype(np.float32)


def test_points_behind_the_wall_are_hidden_and_those_on_it_are_not(wall, rng):
    behind = rng.uniform((-0.5, -0.5, 4.5), (0.5, 0.5, 5), (300, 3)).astype(np.float32)
    xyz = np.concatenate([wall, behind])
    surfaces, cell = find_surfaces(VIEWS, xyz, silent)
    found = find_evidence(VIEWS, xyz, surfaces, cell, None, silent)
    seen = np.zeros(len(xyz), int)
    for each, surface in zip(VIEWS, surfaces, strict=True):
        cam = xyz.astype(float) + each.cam_from_world[:3, 3]
        u, v = F * cam[:, 0] / cam[:, 2] + W / 2, F * cam[:, 1] / cam[:, 2] + H / 2
        inside = (u >= 0) & (u < W) & (v >= 0) & (v < H)
        places = v[inside] * surface.shape[0] / H, u[inside] * surface.shape[1] / W
        limit = surface[tuple(np.array(places).astype(int))] * (1 + module.BEHIND * cell / 4)
        seen[np.flatnonzero(inside)[cam[inside, 2] <= limit]] += 1
    np.testing.assert_array_equal(found.seen, seen)
    middle = (np.abs(wall[:, :2]) < 0.8).all(axis=1)
    assert (found.seen[: len(wall)][middle] == len(VIEWS)).all()
    assert (found.seen[len(wall) :] == 0).all()


def test_colours_are_robust_means_and_agreement_their_share(wall):
    surfaces, cell = find_surfaces(VIEWS, wall, silent)
    found = find_evidence(VIEWS, wall, surfaces, cell, None, silent)
    four = found.seen == 4
    assert four.any()
    assert (found.rgb[four] == 100).all()  # of 100, 104 and 96; 250 is none of them
    np.testing.assert_allclose(found.agreement[four], 0.75)


def test_rays_are_free_up_to_what_stereo_knows(wall):
    ghost = np.array([[0.02, 0.02, 2.0]], np.float32)
    surfaces, cell = find_surfaces(VIEWS, wall, silent)
    known = np.full((H // 4, W // 4), 4.0, np.float32)
    nothing, nobody = np.full_like(known, np.inf), [np.empty((0, 3))] * 4
    rays = free_rays(VIEWS, nobody, [known, known, nothing, nothing])
    xyz = np.concatenate([wall, ghost])
    evidence = find_evidence(VIEWS, xyz, surfaces, cell, rays, silent)
    assert (evidence.through[-1], evidence.through[:-1].max()) == (2, 0)
    assert (evidence.confirmed[-1], evidence.confirmed[:-1].max()) == (0, 2)
    nearer = free_rays(VIEWS, [ghost.astype(float), *nobody[1:]], [known] * 4)
    assert nearer[0].min() == 2.0
