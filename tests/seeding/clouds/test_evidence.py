"""What photographs see of a cloud, against loops over views and points."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.progress import silent
from splatseed.seeding.clouds import judging as module
from splatseed.seeding.clouds.judging import find_evidence, find_surfaces, free_rays
from splatseed.views.view import View

W, H, F = 64, 48, 60.0


def view(x, shade):
    """Looking along z from (x, 0, 0); the photograph has one column of a colour per pixel."""
    pose = np.eye(4)
    pose[0, 3] = -x
    K = np.array([[F, 0, W / 2], [0, F, H / 2], [0, 0, 1.0]])
    return View("", np.full((H, W, 3), shade, np.uint8), K, W, H, pose)


@pytest.fixture
def wall(rng):
    """A wall at depth 4, points at about every pixel."""
    xy = rng.uniform((-2.5, -1.6), (2.5, 1.6), (40000, 2))
    return np.column_stack([xy, np.full(len(xy), 4.0)]).astype(np.float32)


VIEWS = [view(x, shade) for x, shade in ((-0.5, 100), (0.0, 104), (0.5, 96), (0.2, 250))]


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
        rows, cols = (
            (v[inside] * surface.shape[0] / H).astype(int),
            (u[inside] * surface.shape[1] / W).astype(int),
        )
        limit = surface[rows, cols] * (1 + module.BEHIND * cell / 4)
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
    assert evidence.through[-1] == 2
    assert evidence.through[:-1].max() == 0
    assert evidence.confirmed[-1] == 0
    assert evidence.confirmed[:-1].max() == 2
    nearer = free_rays(VIEWS, [ghost.astype(float), *nobody[1:]], [known] * 4)
    assert nearer[0].min() == 2.0
