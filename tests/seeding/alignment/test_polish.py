"""The last stage of an alignment: weights, edges and the covariance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatseed.seeding.alignment import icp
from splatseed.seeding.alignment.icp import Surface, clustered_covariance, moved, polish
from splatseed.seeding.alignment.marks import Marks
from splatseed.seeding.clouds.voxels import normals_of
from splatseed.similarity import Similarity

HERE = Similarity(1.0, np.eye(3), np.zeros(3))
NEAR = moved(HERE, np.zeros(3), np.array([0.001, -0.0015, 0.001, 0.001, 0.0005, -0.001, 0.001]))


@pytest.fixture(scope="module")
def corner():
    """Three walls that meet, and a fourth, so that scale is held too."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.arange(0.0125, 1, 0.025)] * 2))
    z = np.zeros_like(u)
    walls = [(u, v, z), (u, z, v), (z, u, v), (u, v, z + 1), (z + 1, u, v)]
    cloud = np.concatenate([np.column_stack(wall) for wall in walls])
    tree = cKDTree(cloud)
    return Surface(cloud, normals_of(cloud, tree), tree)


def marks_on(corner, rng, num=600):
    """Marks on the walls, not near their edges, and the axis across the wall of each."""
    xyz = rng.uniform(0.15, 0.85, (num, 3))
    axis = rng.integers(0, 3, num)
    xyz[np.arange(num), axis] = np.where(axis == 1, 0, rng.integers(0, 2, num))
    return xyz, np.eye(3)[axis]


def marks(xyz, covariance):
    sensitivity = np.zeros((len(xyz), 3, 2))
    return Marks(xyz, np.zeros(len(xyz)), covariance, sensitivity)


def error(polished, xyz):
    return np.linalg.norm(polished.fitted.cloud_from_scene.points(xyz) - xyz, axis=1).max()


def test_marks_that_are_uncertain_across_the_wall_hardly_pull(corner, rng):
    xyz, across = marks_on(corner, rng)
    doubtful = rng.random(len(xyz)) < 0.5
    xyz_off = xyz + np.where(doubtful[:, None], 0.004 * across, 0)  # all to one side
    sd = np.where(doubtful, 0.01, 0.0002)
    weighted = polish(corner, marks(xyz_off, sd[:, None, None] ** 2 * np.eye(3)), NEAR, 0.01)
    alike = polish(corner, marks(xyz_off, np.tile(1e-4 * np.eye(3), (len(xyz), 1, 1))), NEAR, 0.01)
    assert error(weighted, xyz) < 1e-4
    assert error(alike, xyz) > 1e-3


def test_marks_beside_edges_are_left_out(corner, rng):
    """Half lie in edges, where the mean of the cloud's points lies off both walls."""
    xyz, _ = marks_on(corner, rng)
    edge = np.arange(len(xyz)) % 2 == 0
    xyz[edge] = xyz[edge] * (1, 0, 0)
    found = polish(corner, marks(xyz, np.zeros((len(xyz), 3, 3))), NEAR, 0.01)
    assert error(found, xyz) < 1e-9


def test_the_stated_error_is_the_error(corner, rng, monkeypatch):
    """Over many draws of the marks' noise, whose sizes the covariances have wrong."""
    monkeypatch.setattr(icp, "ROUNDS", 1)
    ratios = []
    for _ in range(12):
        xyz, across = marks_on(corner, rng, 300)
        sd = rng.choice([0.0005, 0.003], len(xyz))
        noisy = xyz + (sd * rng.normal(size=len(xyz)))[:, None] * across
        found = polish(corner, marks(noisy, np.zeros((len(xyz), 3, 3))), HERE, 0.01).fitted
        turn = found.cloud_from_scene.rotation
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        ratios.append(np.linalg.norm(axis / 2) / found.turn)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_the_sensitivity_is_how_the_alignment_follows_marks_that_move(corner, rng):
    xyz, _ = marks_on(corner, rng)
    spin = np.array([0.0, 0.0, 1.0])
    sensitivity = np.zeros((len(xyz), 3, 2))
    sensitivity[:, :, 0] = np.cross(spin, xyz)  # marks that turn about z by a radian per pixel
    leaning = Marks(xyz, np.zeros(len(xyz)), np.zeros((len(xyz), 3, 3)), sensitivity)
    found = polish(corner, leaning, HERE, 0.01)
    np.testing.assert_allclose(found.sensitivity[:, 0], -spin, atol=1e-6)
    assert not found.sensitivity[:, 1].any()


def test_copies_of_an_error_in_a_cell_make_it_no_more_certain(rng):
    A, off, weight = rng.normal(size=(40, 3)), rng.normal(size=40), rng.random(40) + 0.5
    once = clustered_covariance(A, weight, off, np.arange(40))
    copied = [np.repeat(each, 5, axis=0) for each in (A, weight, off, np.arange(40))]
    np.testing.assert_allclose(clustered_covariance(*copied), once, rtol=1e-9)
    apart = clustered_covariance(*copied[:3], np.arange(200))
    np.testing.assert_allclose(apart, once / 5, rtol=1e-9)
