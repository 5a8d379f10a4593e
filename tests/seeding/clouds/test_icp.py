"""ICP: its last stage on made walls: weights, edges, covariance."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.seeding.clouds.icp import (
    CloudSurface,
    RefineSettings,
    clustered_covariance,
    refine,
    retract,
)
from splatseed.seeding.clouds.tie_points import TiePoints
from splatseed.similarity import Similarity

IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))
NEAR = retract(
    IDENTITY, np.zeros(3), np.array([0.001, -0.0015, 0.001, 0.001, 0.0005, -0.001, 0.001])
)


@pytest.fixture(scope="module")
def corner():
    """Three walls that meet, and a fourth, so that scale is constrained too."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.arange(0.0125, 1, 0.025)] * 2))
    z = np.zeros_like(u)
    walls = [(u, v, z), (u, z, v), (z, u, v), (u, v, z + 1), (z + 1, u, v)]
    return CloudSurface.of(np.concatenate([np.column_stack(wall) for wall in walls]))


def points_on_walls(rng, num=600):
    """Points on the walls, away from edges, and the axis across the wall of each."""
    xyz = rng.uniform(0.15, 0.85, (num, 3))
    axis = rng.integers(0, 3, num)
    xyz[np.arange(num), axis] = np.where(axis == 1, 0, rng.integers(0, 2, num))
    return xyz, np.eye(3)[axis]


def tie_points(xyz, sd=0.0, sensitivity=None):
    covariance = np.broadcast_to(sd, len(xyz))[:, None, None] ** 2 * np.eye(3)
    none = np.zeros((len(xyz), 3, 2))
    return TiePoints(
        xyz, np.zeros(len(xyz)), covariance, none if sensitivity is None else sensitivity
    )


def error(alignment, xyz):
    return np.linalg.norm(alignment.cloud_from_scene.points(xyz) - xyz, axis=1).max()


def test_points_uncertain_across_the_wall_have_little_weight(corner, rng):
    xyz, across = points_on_walls(rng)
    uncertain = rng.random(len(xyz)) < 0.5
    xyz_off = xyz + np.where(uncertain[:, None], 0.004 * across, 0)  # all to one side
    weighted = refine(corner, tie_points(xyz_off, np.where(uncertain, 0.01, 0.0002)), NEAR, 0.01)
    assert error(weighted, xyz) < 1e-4
    assert error(refine(corner, tie_points(xyz_off, 0.01), NEAR, 0.01), xyz) > 1e-3


def test_points_near_edges_are_left_out(corner, rng):
    """Half lie in edges, where the mean of the cloud's points lies off both walls."""
    xyz, _ = points_on_walls(rng)
    xyz[::2] *= (1, 0, 0)
    assert error(refine(corner, tie_points(xyz), NEAR, 0.01), xyz) < 1e-9


def test_the_stated_error_is_the_error(corner, rng):
    """Over many draws of noise, whose size the given covariances get wrong."""
    ratios = []
    for _ in range(12):
        xyz, across = points_on_walls(rng, 300)
        sd = rng.choice([0.0005, 0.003], len(xyz))
        noisy = xyz + (sd * rng.normal(size=len(xyz)))[:, None] * across
        found = refine(corner, tie_points(noisy), IDENTITY, 0.01, RefineSettings(rounds=1))
        rotation = found.cloud_from_scene.rotation
        axis = np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        ratios.append(np.linalg.norm(axis / 2) / found.rotation_error)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_sensitivity_is_how_the_alignment_follows_its_points(corner, rng):
    xyz, _ = points_on_walls(rng)
    spin = np.array([0.0, 0.0, 1.0])
    sensitivity = np.zeros((len(xyz), 3, 2))
    sensitivity[:, :, 0] = np.cross(spin, xyz)  # they turn about z by a radian per pixel
    found = refine(corner, tie_points(xyz, sensitivity=sensitivity), IDENTITY, 0.01)
    np.testing.assert_allclose(found.sensitivity[:, 0], -spin, atol=1e-6)
    assert not found.sensitivity[:, 1].any()


def test_one_plane_constrains_too_little(corner, rng):
    plane = CloudSurface.of(corner.xyz[corner.xyz[:, 2] == 0])
    assert refine(plane, tie_points(rng.random((500, 3)) * (1, 1, 0)), NEAR, 0.01) is None


def test_repeated_rows_within_a_cell_add_no_certainty(rng):
    A, off, weight = rng.normal(size=(40, 3)), rng.normal(size=40), rng.random(40) + 0.5
    once = clustered_covariance(A, weight, off, np.arange(40))
    copied = [np.repeat(each, 5, axis=0) for each in (A, weight, off, np.arange(40))]
    np.testing.assert_allclose(clustered_covariance(*copied), once, rtol=1e-9)
    apart = clustered_covariance(*copied[:3], np.arange(200))
    np.testing.assert_allclose(apart, once / 5, rtol=1e-9)
