"""Marks: how exactly points are triangulated, against what is known in closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, Tracks
from splatseed.seeding.alignment.marks import find_marks, pixel_noise, triangulation

FOCAL, BASE, DEPTH = 500.0, 0.2, 4.0
CAMERA = Intrinsics(1, "PINHOLE", 800, 600, (FOCAL, FOCAL, 400.0, 300.0))


def images(count=3):
    """Cameras side by side that look along z."""
    return tuple(
        Image(
            f"{i}.png", i + 1, CAMERA, np.array([1.0, 0, 0, 0]), np.array([-BASE * (i - 1), 0, 0])
        )
        for i in range(count)
    )


def tracks(xyz, length=3, error=1.0):
    num = len(xyz)
    return Tracks(
        np.arange(num), xyz, np.full(num, error), np.arange(num + 1) * length,
        np.tile(np.arange(1, length + 1, dtype=np.uint32), num), np.zeros(num * length, np.uint32),
    )  # fmt: skip


def test_a_point_ahead_is_uncertain_along_the_rays():
    point = tracks(np.array([[0.0, 0, DEPTH]]))
    covariance, sensitivity = triangulation(point, images())
    sigma = pixel_noise(point.errors, point.lengths)[0]
    across = sigma * DEPTH / FOCAL / np.sqrt(3)
    along = sigma * DEPTH**2 / FOCAL / BASE / np.sqrt(2)  # sum of (f b / z^2)^2 over two cameras
    expected = np.array([across, across, along])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance[0])), expected, rtol=1e-6)
    aside = -DEPTH / FOCAL  # a principal point taken for a pixel too far puts the point on the left
    np.testing.assert_allclose(sensitivity[0], [[aside, 0], [0, aside], [0, 0]], atol=1e-6)


def test_the_sensitivity_is_what_triangulation_does():
    """Of a point aside, by turned cameras: the least squares of its pixels tell the same."""
    turned = tuple(
        dataclasses.replace(im, quat=np.array([1.0, 0.1 * i, -0.05 * i, 0.08 * i]))
        for i, im in enumerate(images())
    )  # fmt: skip
    point = np.array([[0.5, -0.3, DEPTH]])
    A = np.concatenate(
        [
            (im.camera.project(point + step * np.eye(3))[0] - im.camera.project(point)[0]).T / step
            for im in turned
            for step in [1e-6]
        ]
    )
    shift = np.tile([1.0, 0.0], 3)
    expected = -np.linalg.lstsq(A, shift, rcond=None)[0]
    _, sensitivity = triangulation(tracks(point), turned)
    np.testing.assert_allclose(sensitivity[0, :, 0], expected, rtol=1e-3)


def test_pixel_noise_is_recovered_and_short_tracks_are_drawn_to_the_median(rng):
    lengths = np.where(np.arange(2000) % 2, 3, 20)
    errors = np.empty(len(lengths))
    for i, num in enumerate(lengths):
        sigma = 0.3 * np.sqrt((2 * num - 3) / (2 * num))  # the point takes three degrees of freedom
        errors[i] = np.linalg.norm(rng.normal(0, sigma, (num, 2)), axis=1).mean()
    found = pixel_noise(errors, lengths)
    assert np.median(found) == pytest.approx(0.3, rel=0.05)
    usual = pixel_noise(np.append(np.full(8, 0.3), 3.0), np.append(np.full(8, 9), 3))[-1]
    longer = pixel_noise(np.append(np.full(8, 0.3), 3.0), np.append(np.full(8, 9), 30))[-1]
    assert usual < longer < 3.0 * np.sqrt(2 / np.pi) * np.sqrt(60 / 57)
    np.testing.assert_array_equal(pixel_noise(np.full(3, -1.0), np.full(3, 5)), 1.0)


def scene(rng, seen=True):
    xyz = rng.uniform(-1, 1, (300, 3)) + np.array([0, 0, DEPTH])
    points = PointCloud(xyz, np.full((300, 3), 90, np.uint8))
    return Scene(points, images(), tracks=tracks(xyz[:250]) if seen else None)


def test_marks_without_tracks_count_as_the_median(rng):
    found = find_marks(scene(rng))
    usual = np.median(np.trace(found.covariance[:250], axis1=1, axis2=2)) / 3
    np.testing.assert_allclose(found.covariance[250:], np.tile(usual * np.eye(3), (50, 1, 1)))
    assert not found.sensitivity[250:].any()
    assert not find_marks(scene(rng, seen=False)).covariance.any()
