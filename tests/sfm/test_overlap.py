"""Overlap of views by their poses: walks, loops, and depths by a first look's matches."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import Camera
from splatseed.sfm.first_look import FIRST_LOOK, choose_pairs
from splatseed.sfm.overlap import expected_agreement, first_pairs, overlaps, points_of_matches

K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])


def camera(center, forward):
    """A level camera of 640 x 480; the world's z is up."""
    forward = np.asarray(forward, float) / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(center, float)
    return Camera(K, 640, 480, pose)


def at_depth(camera, depth):
    uv = (np.indices((6, 8)).reshape(2, -1).T[:, ::-1] + 0.5) * 80
    return camera.unproject(uv, np.full(len(uv), depth))


def pairs_of(cameras, seen):
    return choose_pairs(expected_agreement(overlaps(cameras, seen)))


def partners_of(pairs, view):
    return {i + j - view for i, j in pairs if view in (i, j)}


def turn(count):
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


def test_of_300_views_around_an_object_each_gets_its_neighbours_at_once():
    cameras = [camera(4 * at, -at) for at in turn(300)]
    seen = [at_depth(each, 3.0) for each in cameras]
    start = time.process_time()
    pairs = pairs_of(cameras, seen)
    assert time.process_time() - start < 2  # 0.6 s on an idle core
    nearest = {(0, k % 300) for k in (-5, -4, -3, -2, -1, 1, 2, 3, 4, 5)}
    assert partners_of(pairs, 0) >= {other for _, other in nearest}  # across the end of the list
    assert 300 * FIRST_LOOK.partners / 2 <= len(pairs) < 300 * 20
    assert all(len(partners_of(pairs, i)) >= FIRST_LOOK.partners for i in range(300))
    apart = [min(j - i, 300 - j + i) for i, j in pairs]
    assert max(apart) < 50  # no more than 60 degrees
    assert np.mean(np.array(apart) > 10) > 0.2  # others than the nearest, against drift


def test_a_walk_that_returns_closes_its_loop_and_opposite_views_are_no_pairs():
    # Along one side of a block, back along the other, and along the first again.
    there = [camera([x, 0, 0], [1, 0.3, 0]) for x in np.linspace(0, 20, 40)]
    back = [camera([x, 3, 0], [-1, -0.3, 0]) for x in np.linspace(20, 0, 40)]
    again = [camera([x, 0.1, 0], [1, 0.3, 0]) for x in np.linspace(0, 20, 40)]
    cameras = there + back + again
    seen = [at_depth(each, 5.0) for each in cameras]
    overlap = overlaps(cameras, seen)
    assert overlap[10, 90] > 0.9  # the same place on the way back
    assert overlap[10, 11] > overlap[10, 14] > overlap[10, 30] == 0
    assert np.array_equal(overlap, overlap.T)
    assert not overlap.diagonal().any()
    pairs = choose_pairs(expected_agreement(overlap))
    assert {(10, 90), (10, 11), (39, 40)} <= {*pairs}  # 39 and 40 are successors
    across = {(i, j) for i, j in pairs if i < 40 <= j < 80}
    assert across <= {(38, 40), (39, 40), (39, 41)}  # successors


def test_the_first_look_has_successors_and_views_nearby():
    rng = np.random.default_rng(0)
    order = rng.permutation(30)  # names do not follow the walk
    cameras = [camera([x, 0, 0], [0, 1, 0]) for x in order * 0.5]
    pairs = first_pairs(cameras)
    assert {(i, i + 1) for i in range(29)} <= {*pairs}
    where = np.argsort(order)
    near = [tuple(sorted((where[k], where[k + 2]))) for k in range(2, 26)]
    assert np.mean([pair in pairs for pair in near]) > 0.9
    assert pairs == sorted(set(pairs))
    assert len(pairs) < 30 * 5


def test_depths_are_true_though_rotations_are_off():
    rng = np.random.default_rng(0)
    true = camera([0, 0, 0], [0, 1, 0]), camera([0.5, 0, 0], [-0.1, 1, 0])
    xyz = np.stack([*rng.uniform(-1, 1, (1, 60)), *rng.uniform(3, 6, (1, 60)),
                    *rng.uniform(-1, 1, (1, 60))], axis=1)  # fmt: skip
    rays = tuple((each.project(xyz)[0] - K[:2, 2]) / 500 for each in true)
    relative = true[1].cam_from_world @ true[0].world_from_cam
    relative[:3, 3] *= 7  # matches do not tell the scale
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.radians([0, 3, 0])).as_matrix()
    given = tuple(Camera(K, 640, 480, turned @ each.cam_from_world)
                  for turned, each in zip((off, off.T), true, strict=True))  # fmt: skip
    for points, posed, exact in zip(
        points_of_matches(rays, relative[:3], given), given, true, strict=True
    ):
        depth, expected = posed.project(points)[1], exact.project(xyz)[1]
        np.testing.assert_allclose(depth, expected, rtol=0.02)
    same = points_of_matches(rays, relative[:3], (given[0], given[0]))
    assert len(same[0]) == 0  # no baseline, no depth


@pytest.mark.parametrize("known", [True, False])
def test_views_without_points_have_the_depth_of_the_nearest(known):
    cameras = [camera([x, 0, 0], [0, 1, 0]) for x in (0.0, 1.0, 2.0, 30.0)]
    seen = [np.empty((0, 3))] * 4
    if known:
        seen[0] = at_depth(cameras[0], 4.0)
    overlap = overlaps(cameras, seen)
    assert overlap[0, 1] > overlap[0, 2]
    assert overlap[0, 3] == 0
    if known:
        assert overlap[0, 1] == pytest.approx(6 / 8)  # a step of 1 takes 2 of 8 columns out
