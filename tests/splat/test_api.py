"""``ss.read_gaussians``, ``ss.render`` and ``Gaussians`` as users write them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import splatseed as ss
from splatseed.photos.camera_check import reference_points
from splatseed.photos.view import camera_views
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.rendering import render_view
from splatseed.splat.training_frame import training_frame


@pytest.fixture(scope="module")
def scene(room_path):
    return ss.load_scene(room_path)


@pytest.fixture(scope="module")
def splat(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("splat") / "point_cloud.ply"
    initial_gaussians(scene.points, opacity=0.9).write_ply(path)
    return ss.read_gaussians(path)


def test_render_at_a_scene_image_equals_the_trainers(scene, splat):
    image = scene.images[0]
    picture = ss.render(splat, scene[image.name])
    height, width = image.camera.height, image.camera.width
    assert (picture.dtype, picture.shape) == (np.float32, (height, width, 3))
    assert 0 <= picture.min() < 0.2 < picture.max() <= 1
    frame = training_frame(camera_views(scene.split()[0]), reference_points(scene))
    arrays = frame.gaussians_from_world(splat).arrays()
    params = {name: torch.tensor(array) for name, array in arrays.items()}
    view = frame.view(camera_views([image])[0])
    theirs = render_view(params, view, 3)[0].clamp(0, 1).numpy()
    np.testing.assert_allclose(picture, theirs, atol=2e-3)
    assert np.abs(picture - theirs).mean() < 1e-5


def test_images_views_and_cameras_give_the_same_picture(scene, splat):
    image = scene.images[0]
    picture = ss.render(splat, image, backend="cpu")
    for camera in (image.camera, camera_views([image])[0]):
        np.testing.assert_array_equal(ss.render(splat, camera), picture)
    aside = np.array(image.camera.cam_from_world)
    aside[0, 3] += 0.1
    moved = ss.render(splat, dataclasses.replace(image.camera, cam_from_world=aside))
    assert np.abs(moved - picture).max() > 0.05


def test_gaussians_are_frozen_have_a_short_repr_and_round_trip(splat, tmp_path):
    assert repr(splat) == f"Gaussians({len(splat):,}, SH degree 3)"
    with pytest.raises(ValueError, match="read-only"):
        splat.means[0] = 0
    splat.write_ply(tmp_path / "again.ply")
    again = ss.read_gaussians(tmp_path / "again.ply")
    for name, array in splat.arrays().items():
        np.testing.assert_array_equal(getattr(again, name), array)
