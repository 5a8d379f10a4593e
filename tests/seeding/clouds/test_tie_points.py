"""Tie points: their covariance and sensitivity against closed forms and least squares."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.seeding.clouds.tie_points import pixel_noise, select_tie_points, triangulation
from splatseed.tracks import Tracks

FOCAL, BASE, DEPTH = 500.0, 0.2, 4.0
CAMERA = Intrinsics(1, "PINHOLE", 800, 600, (FOCAL, FOCAL, 400.0, 300.0))
IMAGES = tuple(
    Image(f"{i}.png", i + 1, CAMERA, np.array([1.0, 0, 0, 0]), np.array([-BASE * (i - 1), 0, 0]))
    for i in range(3)
)
"""In a row along x, looking along z."""


def tracks(xyz):
    """Points that all three cameras observe, with an error of a pixel."""
    num = len(xyz)
    return Tracks(
        np.arange(num), xyz, np.ones(num), np.arange(num + 1) * 3,
        np.tile(np.arange(1, 4, dtype=np.uint32), num), np.zeros(num * 3, np.uint32),
    )  # fmt: skip


def test_a_point_ahead_is_uncertain_along_the_rays():
    point = tracks(np.array([[0.0, 0, DEPTH]]))
    covariance, _ = triangulation(point, IMAGES)
    sigma = pixel_noise(point.errors, point.lengths)[0]
    across = sigma * DEPTH / FOCAL / np.sqrt(3)
    along = sigma * DEPTH**2 / FOCAL / BASE / np.sqrt(2)  # sum of (f b / z^2)^2 over two cameras
    expected = np.array([across, across, along])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[0])), expected, rtol=1e-6)


def test_sensitivity_equals_the_shift_of_least_squares():
    """For an off-axis point and rotated cameras, as least squares on its pixels gives it."""
    turned = tuple(
        dataclasses.replace(im, quat=np.array([1.0, 0.1 * i, -0.05 * i, 0.08 * i]))
        for i, im in enumerate(IMAGES)
    )
    point, step = np.array([[0.5, -0.3, DEPTH]]), 1e-6
    pixels = [im.camera.project(point + step * np.eye(3))[0].T for im in turned]
    here = [im.camera.project(point)[0].T for im in turned]
    A = (np.concatenate(pixels) - np.concatenate(here)) / step
    expected = -np.linalg.lstsq(A, np.tile(np.eye(2), (3, 1)), rcond=None)[0]
    _, sensitivity = triangulation(tracks(point), turned)
    np.testing.assert_allclose(sensitivity[0], expected, rtol=1e-3, atol=1e-6)


def test_pixel_noise_is_recovered_and_short_tracks_shrink_to_the_median(rng):
    lengths = np.where(np.arange(2000) % 2, 3, 20)
    errors = np.empty(len(lengths))
    for i, num in enumerate(lengths):
        sigma = 0.3 * np.sqrt((2 * num - 3) / (2 * num))  # the point takes three degrees of freedom
        errors[i] = np.linalg.norm(rng.normal(0, sigma, (num, 2)), axis=1).mean()
    found = pixel_noise(errors, lengths)
    assert np.median(found) == pytest.approx(0.3, rel=0.05)
    few = [pixel_noise(np.r_[np.full(8, 0.3), 3.0], np.r_[np.full(8, 9), n])[-1] for n in (3, 30)]
    assert few[0] < few[1] < 3.0 * np.sqrt(2 / np.pi) * np.sqrt(60 / 57)
    np.testing.assert_array_equal(pixel_noise(np.full(3, -1.0), np.full(3, 5)), 1.0)


def test_points_without_tracks_get_the_median_variance(rng):
    xyz = rng.uniform(-1, 1, (300, 3)) + np.array([0, 0, DEPTH])
    scene = Scene(PointCloud(xyz, np.full((300, 3), 90, np.uint8)), IMAGES)
    found = select_tie_points(scene.replace(tracks=tracks(xyz[:250])))
    typical = np.median(np.trace(found.covariance[:250], axis1=1, axis2=2)) / 3
    np.testing.assert_allclose(found.covariance[250:], np.tile(typical * np.eye(3), (50, 1, 1)))
    assert not found.sensitivity[250:].any()
    assert not select_tie_points(scene).covariance.any()
    none = dataclasses.replace(
        tracks(xyz), offsets=np.zeros(301, int), image_ids=np.empty(0), point2d_idx=np.empty(0)
    )
    assert len(select_tie_points(scene.replace(tracks=none)).xyz) == 300
