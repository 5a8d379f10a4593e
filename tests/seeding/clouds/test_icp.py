"""Marks, against what is known in closed form; and the last stage: weights, edges, covariance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, Tracks
from splatseed.seeding.clouds import icp
from splatseed.similarity import Similarity

FOCAL, BASE, DEPTH = 500.0, 0.2, 4.0
CAMERA = Intrinsics(1, "PINHOLE", 800, 600, (FOCAL, FOCAL, 400.0, 300.0))
IMAGES = tuple(
    Image(f"{i}.png", i + 1, CAMERA, np.array([1.0, 0, 0, 0]), np.array([-BASE * (i - 1), 0, 0]))
    for i in range(3)
)
"""Side by side, looking along z."""


def tracks(xyz):
    """Points that all three saw, with an error of a pixel."""
    num = len(xyz)
    return Tracks(
        np.arange(num), xyz, np.ones(num), np.arange(num + 1) * 3,
        np.tile(np.arange(1, 4, dtype=np.uint32), num), np.zeros(num * 3, np.uint32),
    )  # fmt: skip


def test_a_point_ahead_is_uncertain_along_the_rays():
    point = tracks(np.array([[0.0, 0, DEPTH]]))
    covariance, _ = icp.triangulation(point, IMAGES)
    sigma = icp.pixel_noise(point.errors, point.lengths)[0]
    across = sigma * DEPTH / FOCAL / np.sqrt(3)
    along = sigma * DEPTH**2 / FOCAL / BASE / np.sqrt(2)  # sum of (f b / z^2)^2 over two cameras
    expected = np.array([across, across, along])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[0])), expected, rtol=1e-6)


def test_the_sensitivity_is_what_triangulation_does():
    """Of a point aside, by turned cameras: the least squares of its pixels tell the same."""
    turned = tuple(
        dataclasses.replace(im, quat=np.array([1.0, 0.1 * i, -0.05 * i, 0.08 * i]))
        for i, im in enumerate(IMAGES)
    )
    point, step = np.array([[0.5, -0.3, DEPTH]]), 1e-6
    pixels = [im.camera.project(point + step * np.eye(3))[0].T for im in turned]
    here = [im.camera.project(point)[0].T for im in turned]
    A = (np.concatenate(pixels) - np.concatenate(here)) / step
    expected = -np.linalg.lstsq(A, np.tile(np.eye(2), (3, 1)), rcond=None)[0]
    _, sensitivity = icp.triangulation(tracks(point), turned)
    np.testing.assert_allclose(sensitivity[0], expected, rtol=1e-3, atol=1e-6)


def test_pixel_noise_is_recovered_and_short_tracks_are_drawn_to_the_median(rng):
    lengths = np.where(np.arange(2000) % 2, 3, 20)
    errors = np.empty(len(lengths))
    for i, num in enumerate(lengths):
        sigma = 0.3 * np.sqrt((2 * num - 3) / (2 * num))  # the point takes three degrees of freedom
        errors[i] = np.linalg.norm(rng.normal(0, sigma, (num, 2)), axis=1).mean()
    found = icp.pixel_noise(errors, lengths)
    assert np.median(found) == pytest.approx(0.3, rel=0.05)
    few = [
        icp.pixel_noise(np.r_[np.full(8, 0.3), 3.0], np.r_[np.full(8, 9), n])[-1] for n in (3, 30)
    ]
    assert few[0] < few[1] < 3.0 * np.sqrt(2 / np.pi) * np.sqrt(60 / 57)
    np.testing.assert_array_equal(icp.pixel_noise(np.full(3, -1.0), np.full(3, 5)), 1.0)


def test_marks_without_tracks_count_as_the_median(rng):
    xyz = rng.uniform(-1, 1, (300, 3)) + np.array([0, 0, DEPTH])
    scene = Scene(PointCloud(xyz, np.full((300, 3), 90, np.uint8)), IMAGES)
    found = icp.find_marks(scene.replace(tracks=tracks(xyz[:250])))
    usual = np.median(np.trace(found.covariance[:250], axis1=1, axis2=2)) / 3
    np.testing.assert_allclose(found.covariance[250:], np.tile(usual * np.eye(3), (50, 1, 1)))
    assert not found.sensitivity[250:].any()
    assert not icp.find_marks(scene).covariance.any()
    none = dataclasses.replace(
        tracks(xyz), offsets=np.zeros(301, int), image_ids=np.empty(0), point2d_idx=np.empty(0)
    )
    assert len(icp.find_marks(scene.replace(tracks=none)).xyz) == 300


HERE = Similarity(1.0, np.eye(3), np.zeros(3))
NEAR = icp.moved(HERE, np.zeros(3), np.array([0.001, -0.0015, 0.001, 0.001, 0.0005, -0.001, 0.001]))


@pytest.fixture(scope="module")
def corner():
    """Three walls that meet, and a fourth, so that scale is held too."""
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.arange(0.0125, 1, 0.025)] * 2))
    z = np.zeros_like(u)
    walls = [(u, v, z), (u, z, v), (z, u, v), (u, v, z + 1), (z + 1, u, v)]
    return icp.Surface.of(np.concatenate([np.column_stack(wall) for wall in walls]))


def marks_on_walls(rng, num=600):
    """Marks on the walls, not near their edges, and the axis across the wall of each."""
    xyz = rng.uniform(0.15, 0.85, (num, 3))
    axis = rng.integers(0, 3, num)
    xyz[np.arange(num), axis] = np.where(axis == 1, 0, rng.integers(0, 2, num))
    return xyz, np.eye(3)[axis]


def marks(xyz, sd=0.0, sensitivity=None):
    covariance = np.broadcast_to(sd, len(xyz))[:, None, None] ** 2 * np.eye(3)
    none = np.zeros((len(xyz), 3, 2))
    return icp.Marks(
        xyz, np.zeros(len(xyz)), covariance, none if sensitivity is None else sensitivity
    )


def error(polished, xyz):
    return np.linalg.norm(polished.cloud_from_scene.points(xyz) - xyz, axis=1).max()


def test_marks_that_are_uncertain_across_the_wall_hardly_pull(corner, rng):
    xyz, across = marks_on_walls(rng)
    doubtful = rng.random(len(xyz)) < 0.5
    xyz_off = xyz + np.where(doubtful[:, None], 0.004 * across, 0)  # all to one side
    weighted = icp.polish(corner, marks(xyz_off, np.where(doubtful, 0.01, 0.0002)), NEAR, 0.01)
    assert error(weighted, xyz) < 1e-4
    assert error(icp.polish(corner, marks(xyz_off, 0.01), NEAR, 0.01), xyz) > 1e-3


def test_marks_beside_edges_are_left_out(corner, rng):
    """Half lie in edges, where the mean of the cloud's points lies off both walls."""
    xyz, _ = marks_on_walls(rng)
    xyz[::2] *= (1, 0, 0)
    assert error(icp.polish(corner, marks(xyz), NEAR, 0.01), xyz) < 1e-9


def test_the_stated_error_is_the_error(corner, rng, monkeypatch):
    """Over many draws of the marks' noise, whose sizes the covariances have wrong."""
    monkeypatch.setattr(icp, "ROUNDS", 1)
    ratios = []
    for _ in range(12):
        xyz, across = marks_on_walls(rng, 300)
        sd = rng.choice([0.0005, 0.003], len(xyz))
        noisy = xyz + (sd * rng.normal(size=len(xyz)))[:, None] * across
        found = icp.polish(corner, marks(noisy), HERE, 0.01)
        turn = found.cloud_from_scene.rotation
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        ratios.append(np.linalg.norm(axis / 2) / found.turn)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_the_sensitivity_is_how_the_alignment_follows_marks_that_move(corner, rng):
    xyz, _ = marks_on_walls(rng)
    spin = np.array([0.0, 0.0, 1.0])
    sensitivity = np.zeros((len(xyz), 3, 2))
    sensitivity[:, :, 0] = np.cross(spin, xyz)  # marks that turn about z by a radian per pixel
    found = icp.polish(corner, marks(xyz, sensitivity=sensitivity), HERE, 0.01)
    np.testing.assert_allclose(found.sensitivity[:, 0], -spin, atol=1e-6)
    assert not found.sensitivity[:, 1].any()


def test_one_plane_holds_nothing(corner, rng):
    plane = icp.Surface.of(corner.xyz[corner.xyz[:, 2] == 0])
    assert icp.polish(plane, marks(rng.random((500, 3)) * (1, 1, 0)), NEAR, 0.01) is None


def test_copies_of_an_error_in_a_cell_make_it_no_more_certain(rng):
    A, off, weight = rng.normal(size=(40, 3)), rng.normal(size=40), rng.random(40) + 0.5
    once = icp.clustered_covariance(A, weight, off, np.arange(40))
    copied = [np.repeat(each, 5, axis=0) for each in (A, weight, off, np.arange(40))]
    np.testing.assert_allclose(icp.clustered_covariance(*copied), once, rtol=1e-9)
    apart = icp.clustered_covariance(*copied[:3], np.arange(200))
    np.testing.assert_allclose(apart, once / 5, rtol=1e-9)
