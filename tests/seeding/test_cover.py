"""Cover: a seed in every empty cell, compared with literal loops and a room of known depth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.errors import ParameterError, PointCloudError
from splatseed.photos.zbuffer import cell_depths
from splatseed.progress import silent
from splatseed.seeding import cover as module
from splatseed.seeding.cover import (
    cover,
    covered_share,
    guess_depths,
    reference_depths,
    world_from_cells,
)

from ..seeds_of_views import seeds_of_views
from . import references as slow


def holds_points(view, xyz, cell):
    """Which cells of a view hold a point, hidden or not."""
    m, rows, cols = slow.matrix_of(view, cell)
    cells = np.zeros((rows, cols), bool)
    for point in xyz:
        at = slow.project(point, m)
        if at and 0 <= at[0] < cols and 0 <= at[1] < rows:
            cells[int(at[1]), int(at[0])] = True
    return cells


def ring(rng, num, width=48, height=36):
    """Views from all around."""
    angles = np.arange(num) * 2 * np.pi / num
    eyes = np.stack([np.cos(angles), np.sin(angles), 0.4 + 0 * angles], axis=1)
    return [slow.make_view(rng, width, height, 40, eye, name=f"{k}") for k, eye in enumerate(eyes)]


def cover_views(views, xyz, **options):
    """Cover's seeds, and the index of the view that each comes from."""
    return seeds_of_views(
        module,
        lambda view, *_: next(i for i, each in enumerate(views) if each is view),
        lambda: cover(views, xyz, **options),
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cell", [5, 8])
def test_seeds_equal_the_loop(seed, cell):
    rng = np.random.default_rng(seed)
    views, xyz = ring(rng, 3), rng.normal(size=(40, 3)).astype(np.float32)
    seeds, view_idx = cover_views(views, xyz, cell=cell, rng=np.random.default_rng(seed))
    expected = slow.cover(views, xyz, cell, np.random.default_rng(seed))
    assert len(seeds) == len(expected)
    positions, colors, idx, confidence = map(np.array, zip(*expected, strict=True))
    np.testing.assert_array_equal(view_idx, idx)
    np.testing.assert_allclose(seeds.xyz, positions, rtol=1e-4, atol=1e-4)
    assert np.abs(seeds.rgb - colors).max() <= 0.5
    np.testing.assert_allclose(seeds.confidence, confidence, rtol=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.sampled_from([1, 7, 50]))
@settings(max_examples=15, deadline=None)
def test_every_cell_of_every_view_holds_a_point(seed, num_views, num_points):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 60, (num_views, 2))
    views = [slow.make_view(rng, int(w), int(h), rng.uniform(5, 90)) for w, h in sizes]
    xyz = (0.01 * rng.normal(size=(num_points, 3))).astype(np.float32)
    seeds = cover(views, xyz, rng=rng)
    assert np.isfinite(seeds.xyz).all()
    assert (seeds.sizes > 0).all()
    assert (seeds.confidence >= np.float32(0.1)).all()
    assert (seeds.confidence <= np.float32(0.3)).all()
    for view in views:
        assert holds_points(view, np.concatenate([xyz, seeds.xyz]), 8).all()


def test_seeds_of_a_wall_lie_on_it(rng):
    """A view that looks straight at a wall: all depths around a gap are its depth."""
    view = slow.make_view(rng, 64, 48, 50, eye=(0, -1, 0))
    depth = np.linalg.norm(view.cam_from_world[:3, 3])
    i, j = np.divmod(rng.permutation(48)[:20], 8)
    wall = np.float32([slow.lift(view, 8, a, b, depth) for a, b in zip(i, j, strict=True)])
    seeds = cover([view], wall, rng=rng)
    assert len(seeds) == 48 - 20
    np.testing.assert_allclose(seeds.xyz @ view.cam_from_world[2, :3], 0, atol=1e-5)
    np.testing.assert_allclose(seeds.sizes, 8 * depth / np.sqrt(50 * 55), rtol=1e-5)


def test_a_seed_takes_the_surface_that_no_view_sees_through(rng):
    """Near the edge of a near surface, other views see through seeds at its depth to a far one."""
    view = slow.make_view(rng, 80, 48, 60, eye=(0, -1, 0))
    left = [slow.lift(view, 8, i, j, 2.0) for i in range(6) for j in range(4)]
    right = [slow.lift(view, 8, i, j, 4.0) for i in range(6) for j in range(6, 10)]
    points = np.float32([*left, *right])
    others = []
    for step in (1.0, 1.05, 1.1):
        pose = view.cam_from_world.copy()
        pose[0, 3] += step
        others.append(view.posed(pose))
    reference = reference_depths(others, points, 8, silent)
    depths = cell_depths(view.camera, points, 8)
    gap = np.flatnonzero(np.isinf(depths))
    back = world_from_cells(view, 8)
    for checked, expected in ((0, [2, 4]), (3, [4, 4])):
        guesses, distances = guess_depths(depths, gap, back, reference, np.arange(checked))
        inner = guesses.reshape(6, 2)[1:5]  # the first and last row have fewer around them
        np.testing.assert_allclose(inner, [expected] * 4, rtol=1e-5)
        assert (distances == 1).all()


def test_the_room_is_covered_near_its_surfaces(room_capture, room_views, rng):
    xyz = room_capture.scene.points.xyz
    seeds, view_idx = cover_views(room_views, xyz, rng=rng)
    before = covered_share(room_views, xyz)
    assert before < 0.8
    assert covered_share(room_views, np.concatenate([xyz, seeds.xyz])) > 0.95
    off = room_capture.surfaces.distance(seeds.xyz.astype(np.float64))
    assert np.median(off) < 0.12  # of a room of 4.6 m
    for k, view in enumerate(room_views):
        mine = view_idx == k
        matrix = slow.matrix_of(view, 1)[0]
        at = np.array([slow.project(point, matrix) for point in seeds.xyz[mine]]).reshape(-1, 3)
        column, row = at[:, 0].astype(int), at[:, 1].astype(int)
        gap = np.abs(seeds.rgb[mine].astype(float) - view.photograph[row, column]).mean()
        assert gap < 25


def test_the_same_seed_gives_the_same_bytes(room_capture, room_views):
    xyz = room_capture.scene.points.xyz
    first, again, other = (
        cover(room_views, xyz, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert first == again
    assert first.xyz.tobytes() != other.xyz.tobytes()


def test_a_view_without_points_takes_the_depth_of_the_others(rng):
    seeing = slow.make_view(rng, eye=(0, -1, 0))
    blind = slow.make_view(rng, eye=(0, -1, 0), target=(0, -20, 0))
    xyz = (0.1 * rng.normal(size=(50, 3))).astype(np.float32)
    seeds, view_idx = cover_views([seeing, blind], xyz, rng=rng)
    mine = seeds.xyz[view_idx == 1]
    pose = blind.cam_from_world
    depth = np.linalg.norm(seeing.cam_from_world[:3, 3])
    np.testing.assert_allclose(mine @ pose[2, :3] + pose[2, 3], depth, rtol=0.1)
    np.testing.assert_array_equal(seeds.confidence[view_idx == 1], np.float32(0.1))


def test_masked_cells_get_no_seed(rng):
    view = slow.make_view(rng, 64, 48)
    xyz = np.zeros((1, 3), np.float32)
    mask = np.ones((48, 64), bool)
    mask[:, :20] = False  # of the third column of cells one half
    seeds = cover([view], xyz, rng=rng, masks=[mask])
    column = seeds.xyz @ (slow.matrix_of(view, 8)[0][:, :3]).T + slow.matrix_of(view, 8)[0][:, 3]
    assert (column[:, 0] / column[:, 2]).min() == pytest.approx(2.5)
    third = np.abs(column[:, 0] / column[:, 2] - 2.5) < 1e-3
    row = (column[third, 1] / column[third, 2]).astype(int)
    expected = [view.photograph[8 * i : 8 * i + 8, 20:24].reshape(-1, 3).mean(axis=0) for i in row]
    assert np.abs(seeds.rgb[third] - expected).max() <= 0.5
    assert not len(cover([view], xyz, rng=rng, masks=[np.zeros_like(mask)]))


def test_full_coverage_needs_no_seed(rng):
    view = slow.make_view(rng, 16, 16)
    xyz = np.float32([slow.lift(view, 8, i, j, 2.0) for i in range(2) for j in range(2)])
    seeds = cover([view], xyz, rng=rng)
    assert (len(seeds), seeds.xyz.shape, seeds.rgb.dtype) == (0, (0, 3), np.uint8)


def test_bad_input_is_refused(rng):
    view, xyz = slow.make_view(rng), np.zeros((1, 3), np.float32)
    unseen = dataclasses.replace(view, photograph=np.empty((0, 0, 3), np.uint8))
    with pytest.raises(ParameterError, match="pixels of 40 x 32"):
        cover([unseen], xyz, rng=rng)
    with pytest.raises(ParameterError, match="mask of 40 x 32"):
        cover([view], xyz, rng=rng, masks=[np.ones((4, 4), bool)])
    with pytest.raises(ParameterError, match="each of 1 views"):
        cover([view], xyz, rng=rng, masks=[])
    with pytest.raises(ParameterError, match="at least one view"):
        cover([], xyz, rng=rng)
    behind = np.float32([2 * np.linalg.inv(view.cam_from_world)[:3, 3]])
    for points in (xyz[:0], behind, xyz * np.nan):
        with pytest.raises(PointCloudError, match="lies in one of the views"):
            cover([view], points, rng=rng)
