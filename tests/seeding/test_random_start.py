"""The random start of trainers: how many points, how far around the cameras, wherever they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.seeding.poses_alone.random_start import random_start
from splatseed.synthetic import make_capture


@pytest.fixture(scope="module")
def scene():
    return make_capture(0, num_views=6, width=32, height=32).scene


@pytest.mark.parametrize(("trainer", "num"), [("gsplat", 100_000), ("nerfstudio", 50_000)])
def test_points_fill_a_cube_around_the_cameras(scene, trainer, num):
    points = random_start(scene, np.random.default_rng(0), trainer)
    assert len(points) == num
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    np.testing.assert_allclose(high - low, (high - low)[0], rtol=1e-3)
    centers = np.stack([image.camera.center for image in scene.images])
    assert (centers > low).all()
    assert (centers < high).all()
    again = random_start(scene, np.random.default_rng(0), trainer)
    assert again.xyz.tobytes() == points.xyz.tobytes()


@pytest.mark.parametrize("trainer", ["gsplat", "nerfstudio"])
def test_the_cube_grows_with_the_cameras(scene, trainer):
    def scaled(image):
        return dataclasses.replace(image, translation=10 * image.translation)

    far = scene.replace(images=tuple(map(scaled, scene.images)))
    near, wide = (
        random_start(each, np.random.default_rng(0), trainer).xyz for each in (scene, far)
    )
    np.testing.assert_allclose(wide, 10 * near, rtol=1e-4, atol=1e-4)
