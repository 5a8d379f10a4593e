"""Which views are compared, against loops."""

from __future__ import annotations

import numpy as np

from splatseed.photos.sources import ANGLES, choose_by_pose, choose_sources


def worth(seen, xyz, centers, i: int, j: int) -> float:
    total = 0.0
    for point in set(seen[i].tolist()) & set(seen[j].tolist()):
        rays = [xyz[point] - centers[k] for k in (i, j)]
        cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
        degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        total += np.interp(degrees, ANGLES, [0, 1, 1, 0])
    return total


def test_pairs_equal_those_of_a_plain_loop(rng):
    """Eight cameras about 40 points, each of which sees some of them."""
    xyz, centers = rng.normal(size=(40, 3)), rng.normal(size=(8, 3)) - np.array([0, 0, 5])
    seen = [np.sort(rng.choice(40, rng.integers(5, 30), replace=False)) for _ in centers]
    chosen = choose_sources(seen, xyz, centers, 4)
    assert chosen.shape == (8, 4)
    for i, mine in enumerate(chosen):
        worths = np.array([0.0 if j == i else worth(seen, xyz, centers, i, j) for j in range(8)])
        ours = [worths[j] if j >= 0 else 0.0 for j in mine]
        np.testing.assert_allclose(ours, np.sort(worths)[::-1][:4], atol=1e-9)


def test_views_without_common_points_are_not_paired():
    xyz = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    centers = np.array([[0.0, 0, -5], [1.0, 0, -5], [2.0, 0, -5]])
    seen = [np.array([0]), np.array([0, 1]), np.array([1])]
    np.testing.assert_array_equal(choose_sources(seen, xyz, centers, 2), [[1, -1], [0, 2], [1, -1]])
    for num in (0, 1, 3):
        chosen = choose_sources([np.empty(0, int)] * num, xyz[:0], np.zeros((num, 3)), 5)
        np.testing.assert_array_equal(chosen, np.full((num, 5), -1))


def test_a_distant_camera_is_no_neighbour():
    """Sources without points: distances once counted relative to the largest of all."""
    poses = np.tile(np.eye(4), (13, 1, 1))
    poses[:12, 0, 3] = 0.1 * np.arange(12)
    poses[12, 0, 3] = 1e7
    chosen = choose_by_pose(poses, 4)
    assert (chosen[:12] >= 0).all()
    np.testing.assert_array_equal(chosen[:12], choose_by_pose(poses[:12], 4))
