"""Seeds from maps: on the surface, spread as asked, each with what is known of it."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.stereo import fusion
from splatseed.depth.stereo.fusion import SAME_DEPTH, fuse

from ...seeds_of_views import seeds_of_views

CELL = 6.0


@pytest.fixture(scope="module")
def made(ball):
    """Seeds, and the index of the view that each comes from."""
    return seeds_of_views(fusion, lambda _stereo, i, _places: i, lambda: fuse(ball.stereo, CELL))


@pytest.fixture(scope="module")
def seeds(made):
    return made[0]


def test_seeds_lie_on_the_surface_with_its_normals_most_confident_first(made, ball):
    seeds, view_idx = made
    xyz = seeds.xyz.astype(np.float64)
    assert np.quantile(ball.surfaces.distance(xyz), 0.9) < 0.04
    cosine = np.abs((ball.surfaces.normals(xyz) * seeds.normals).sum(axis=1))
    assert np.degrees(np.arccos(np.median(cosine))) < 12
    np.testing.assert_allclose(np.linalg.norm(seeds.normals, axis=1), 1.0, atol=1e-5)
    assert (np.diff(view_idx) >= 0).all()
    for i in np.unique(view_idx):
        assert (np.diff(seeds.confidence[view_idx == i]) <= 0).all()
    assert ((seeds.confidence > 0) & (seeds.confidence <= 1)).all()


def test_a_cell_of_a_view_has_one_seed_at_a_depth(made, ball):
    """Asked of the view that each comes from, where it certainly counts."""
    seeds, view_idx = made
    for i, view in enumerate(ball.stereo.views):
        uv, z = view.camera.project(seeds.xyz[view_idx == i].astype(float))
        cells = np.floor(uv / CELL).astype(int)
        for cell in np.unique(cells, axis=0):
            here = np.sort(1.0 / z[(cells == cell).all(axis=1)])
            assert (np.diff(here) / here[:-1] > SAME_DEPTH / (1 + SAME_DEPTH) - 1e-4).all()


def test_each_confirmed_pixel_has_a_seed_near_it(seeds, ball):
    """What was left out has a seed in its cell, in its own view or a confirming one."""
    stereo, xyz = ball.stereo, seeds.xyz.astype(float)
    for i, view in enumerate(stereo.views):
        stereo_map = stereo.map(i)
        row, column = np.nonzero(stereo.confirmed(i))
        depth = stereo_map.depth[row, column]
        points = stereo_map.camera.unproject(np.stack([column, row], axis=1) + 0.5, depth)
        gap = np.linalg.norm(points[:, None] - xyz, axis=2).min(axis=1)
        # A cell's diagonal across the line of sight, and as much along it.
        assert np.quantile(gap / (CELL * depth / view.K[0, 0]), 0.99) < 3


def test_larger_cells_give_fewer_seeds_and_never_finer_than_the_maps(seeds, ball):
    assert len(fuse(ball.stereo, 2 * CELL)) < 0.7 * len(seeds) < len(seeds)
    finest = fuse(ball.stereo, 2.0)
    np.testing.assert_array_equal(fuse(ball.stereo, 0.1).xyz, finest.xyz)
    assert len(finest) > len(seeds)
