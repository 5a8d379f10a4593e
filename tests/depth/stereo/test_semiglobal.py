"""Semi-global matching: kernels against the equations, and depth where one view alone sees."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera
from splatseed.depth.stereo._kernels.semiglobal import (
    BEHIND,
    IN_FRONT,
    OUTSIDE,
    SEEN,
    aggregate,
    cheapest,
    combine,
    correlate,
    place,
)
from splatseed.depth.stereo.matching import other_from_view
from splatseed.depth.stereo.semiglobal import _hypotheses, _nearest, semiglobal_depths
from splatseed.photos.loading import load_views
from splatseed.photos.panorama import FACES
from splatseed.photos.view import NO_PIXELS, View
from splatseed.progress import silent

from .made import arc, ball_before_wall, photograph, true_depth


def test_path_costs_follow_the_recurrence():
    rng = np.random.default_rng(0)
    costs = rng.random((5, 6, 7)).astype(np.float32)
    grey = rng.uniform(0, 255, (5, 6)).astype(np.float32)
    small, large, contrast = 0.1, 2.0, 30.0
    for down, across in ((0, 1), (0, -1), (1, 0), (-1, -1), (1, -1)):
        total = np.zeros_like(costs)
        aggregate(costs, grey, down, across, np.float32(small), large, contrast, total)
        path = np.zeros(costs.shape)
        rows = range(5) if down >= 0 else range(4, -1, -1)
        for y in rows:
            for x in range(6) if across >= 0 else range(5, -1, -1):
                q = y - down, x - across
                path[y, x] = costs[y, x]
                if 0 <= q[0] < 5 and 0 <= q[1] < 6:
                    jump = max(large * np.exp(-abs(grey[y, x] - grey[q]) / contrast), 1.5 * small)
                    for d in range(7):
                        near = [path[q][k] + small for k in (d - 1, d + 1) if 0 <= k < 7]
                        least = min(path[q][d], *near, path[q].min() + jump)
                        path[y, x, d] += least - path[q].min()
        np.testing.assert_allclose(total, path, atol=1e-5)


def test_costs_are_one_minus_the_correlation_of_windows():
    rng = np.random.default_rng(1)
    a, b = (rng.uniform(0, 255, (12, 11)).astype(np.float32) for _ in range(2))
    out = np.empty_like(a)
    correlate(a, b, 2, 0.0, np.empty((5, 11)), out)
    for y, x in ((5, 5), (0, 0), (11, 10), (3, 9)):
        windows = [p[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].ravel() for p in (a, b)]
        assert out[y, x] == pytest.approx(min(1 - np.corrcoef(*windows)[0, 1], 1), abs=1e-5)
    correlate(a, 3 * a + 7, 2, 0.0, np.empty((5, 11)), out)
    np.testing.assert_allclose(out, 0, atol=1e-5)


def test_what_no_view_sees_costs_neither_little_nor_much():
    costs = np.array([0.2, 0.4, 0.1], np.float32)[:, None, None]
    out = np.empty((1, 1), np.float32)
    for places, cost in (
        ((SEEN, SEEN, OUTSIDE), 0.25 * 0.2 + 0.75 * 0.3),
        ((SEEN, IN_FRONT, BEHIND), 0.25 * 0.2 + 0.75 * (0.2 + 0.4 + 0.5) / 2),
        ((OUTSIDE, BEHIND, OUTSIDE), 0.7),
    ):
        combine(costs, np.array(places, np.uint8)[:, None, None], 0.25, 0.7, 0.5, out)
        assert out[0, 0] == pytest.approx(cost)


def test_places_and_samples_on_a_plane(tmp_path):
    scene = photograph(tmp_path, ball_before_wall(), arc((0.0, 7.0)))
    view, other = load_views(scene, scene.images)
    grey = other.photograph[..., 0].astype(np.float32)
    z, shape = 3.2, (view.height, view.width)
    surface = np.full(grey.shape, z, np.float32)
    sampled, places = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    for scale, where in ((1.0, SEEN), (0.5, BEHIND), (2.0, IN_FRONT)):
        there = surface * np.float32(scale)
        warp, w = other_from_view(view, other), np.float32(1 / z)
        place(warp, w, grey, there, 0.2, sampled, places)
        row, column = np.mgrid[: shape[0], : shape[1]]
        uv = np.stack([column.ravel(), row.ravel()], axis=1) + 0.5
        at, depth = other.camera.project(view.camera.unproject(uv, np.full(len(uv), z)))
        inside = ((at >= 0) & (at < [other.width, other.height])).all(axis=1)
        clear = inside & (np.abs(depth / z - 1) < 0.15)
        assert clear.sum() > 1000
        assert (places.ravel()[clear] == where).all()
        assert (places.ravel()[~inside] == OUTSIDE).all()
    k = int(np.flatnonzero(clear)[1234])
    x, y = at[k] - 0.5
    p, q = int(y), int(x)
    rows = grey[p : p + 2, q : q + 2] @ [1 - (x - q), x - q]
    assert sampled.ravel()[k] == pytest.approx(rows @ [1 - (y - p), y - p], abs=0.01)


def test_the_depth_of_the_smallest_cost_lies_between_hypotheses():
    w = np.linspace(0.1, 1.0, 10, dtype=np.float32)
    total = ((np.arange(10) - 4.3) ** 2).astype(np.float32)[None, None]
    out = np.empty((1, 1), np.float32)
    cheapest(total, w, out)
    assert 1 / out[0, 0] == pytest.approx(0.1 + 0.1 * 4.3, abs=1e-5)


def test_views_of_the_same_place_are_not_compared_and_of_another_first_what_looks_alike():
    poses = np.tile(np.eye(4), (12, 1, 1))
    for k, (place_at, face) in enumerate((p, f) for p in (0.0, 0.7) for f in FACES.values()):
        poses[k, :3, :3] = face
        poses[k, :3, 3] = -face @ [1.2 + place_at, 1.5, 0.3]
    for i in range(12):
        others = _nearest(poses, i)
        assert sorted(others) == [k for k in range(12) if (k < 6) != (i < 6)]
        assert others[0] == (i + 6) % 12  # the same face


def test_points_beside_a_camera_do_not_widen_its_range_of_depth():
    pose = np.eye(4)
    view = View(
        "a", NO_PIXELS, Camera(np.array([[50.0, 0, 40], [0, 50, 30], [0, 0, 1]]), 80, 60, pose)
    )
    rng = np.random.default_rng(3)
    seen = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.uniform(4, 5, 50)])
    beside = np.column_stack([rng.uniform(5, 9, (50, 2)), rng.uniform(0.001, 0.1, 50)])
    behind = seen * [1, 1, -1]
    alone = _hypotheses(view, seen)
    np.testing.assert_array_equal(_hypotheses(view, np.concatenate([seen, beside, behind])), alone)
    assert 3 < 1 / alone[-1] < 4
    assert 5 < 1 / alone[0] < 7
    far = _hypotheses(view, behind)  # sees none: as far as they are
    assert 3 < 1 / far[-1] < 1 / far[0] < 7


def test_every_pixel_has_a_depth_and_what_one_view_sees_alone_lies_on_its_surface(tmp_path):
    scene = photograph(tmp_path, ball_before_wall(), arc((0.0, 12.0)))
    views = load_views(scene, scene.images)
    depths = semiglobal_depths(views, scene.points.xyz.astype(np.float64), silent)
    for i, (view, depth) in enumerate(zip(views, depths, strict=True)):
        truth = true_depth(ball_before_wall(), view.camera)
        error = np.abs(depth / truth - 1)
        assert (error < 0.03).mean() > 0.9
        row, column = np.mgrid[: view.height, : view.width]
        uv = np.stack([column.ravel(), row.ravel()], axis=1) + 0.5
        xyz = view.camera.unproject(uv, truth.ravel())
        alone = np.ones(len(xyz), bool)
        for j, other in enumerate(views):
            if j != i:
                at, z = other.camera.project(xyz)
                inside = ((at >= 0) & (at < [other.width, other.height])).all(axis=1)
                across, down = at[inside].astype(int).T
                shown = true_depth(ball_before_wall(), other.camera)[down, across]
                alone[np.flatnonzero(inside)[z[inside] < shown * 1.02]] = False
        assert alone.sum() > 100
        assert (error.ravel()[alone] < 0.05).mean() > 0.9
    again = semiglobal_depths(views, scene.points.xyz.astype(np.float64), silent)
    assert all((a == b).all() for a, b in zip(depths, again, strict=True))
