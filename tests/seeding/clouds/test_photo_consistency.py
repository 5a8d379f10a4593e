"""Photo-consistency of made clouds: support, visibility, colours and free space."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.progress import silent
from splatseed.seeding.clouds.photo_consistency import (
    CONSISTENCY,
    find_evidence,
    find_support,
    find_surfaces,
    free_space,
)


def view(center, focal, width, height, shade=0):
    """Looking along z, at one grey."""
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(center, float)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return View("", np.full((height, width, 3), shade, np.uint8), Camera(K, width, height, pose))


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
        cells = v[inside] * surface.shape[0] / H, u[inside] * surface.shape[1] / W
        limit = surface[tuple(np.array(cells).astype(int))] * (1 + CONSISTENCY.behind * cell / 4)
        seen[np.flatnonzero(inside)[cam[inside, 2] <= limit]] += 1
    np.testing.assert_array_equal(found.num_views, seen)
    middle = (np.abs(wall[:, :2]) < 0.8).all(axis=1)
    assert (found.num_views[: len(wall)][middle] == len(VIEWS)).all()
    assert (found.num_views[len(wall) :] == 0).all()


def test_colours_are_robust_means(wall):
    surfaces, cell = find_surfaces(VIEWS, wall, silent)
    found = find_evidence(VIEWS, wall, surfaces, cell, None, silent)
    four = found.num_views == 4
    assert four.any()
    assert (found.rgb[four] == 100).all()  # of 100, 104 and 96; 250 is none of them
    np.testing.assert_allclose(found.agreement[four], 0.75)


def test_rays_are_free_up_to_the_depths_of_stereo(wall):
    ghost = np.array([[0.02, 0.02, 2.0]], np.float32)
    surfaces, cell = find_surfaces(VIEWS, wall, silent)
    known = np.full((H // 4, W // 4), 4.0, np.float32)
    nothing, nobody = np.full_like(known, np.inf), [np.empty((0, 3))] * 4
    rays = free_space(VIEWS, nobody, [known, known, nothing, nothing])
    xyz = np.concatenate([wall, ghost])
    evidence = find_evidence(VIEWS, xyz, surfaces, cell, rays, silent)
    assert (evidence.violations[-1], evidence.violations[:-1].max()) == (2, 0)
    assert (evidence.confirmations[-1], evidence.confirmations[:-1].max()) == (0, 2)
    nearer = free_space(VIEWS, [ghost.astype(float), *nobody[1:]], [known] * 4)
    assert nearer[0].min() == 2.0
