"""Views: the box filter, intrinsics that go with it, the cache, the split, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.views.photographs import load_photograph
from splatseed.views.view import load_split, load_views


@pytest.fixture
def picture(tmp_path, rng):
    path = tmp_path / "a.png"
    PilImage.fromarray(rng.integers(0, 256, (23, 37, 3), np.uint8)).save(path)
    return path


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
def test_a_smaller_photograph_is_the_mean_over_blocks(picture, factor):
    full = np.asarray(PilImage.open(picture), np.float64)
    pixels, size = load_photograph(picture, factor)
    height, width = 23 // factor, 37 // factor
    blocks = full[: height * factor, : width * factor]
    means = blocks.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
    assert size == (37, 23)
    assert pixels.shape == (height, width, 3)
    assert np.abs(pixels - means).max() < 0.6  # Pillow rounds in fixed point


def test_the_cache_is_used_and_knows_a_changed_photograph(picture, tmp_path):
    cache = tmp_path / "cache"
    first, _ = load_photograph(picture, 2, cache)
    (kept,) = cache.iterdir()
    PilImage.fromarray(255 - first).save(kept)
    assert np.array_equal(load_photograph(picture, 2, cache)[0], 255 - first)
    kept.write_bytes(b"damaged")
    assert np.array_equal(load_photograph(picture, 2, cache)[0], first)
    PilImage.new("RGB", (37, 23), (9, 9, 9)).save(picture)
    assert (load_photograph(picture, 2, cache)[0] == 9).all()


def test_transparent_pixels_are_black(tmp_path):
    path = tmp_path / "a.png"
    PilImage.new("RGBA", (12, 12), (200, 100, 50, 0)).save(path)
    assert not load_photograph(path)[0].any()


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_point_stays_on_its_pixel(room, factor):
    """A point's pixel in the view is its pixel in the camera record over the factor."""
    image = room.images[0]
    (view,) = load_views(room, [image], data_factor=factor)
    xyz = room.points.xyz[:50]
    uv, depth = image.camera.project(xyz)
    homogeneous = (view.cam_from_world[:3, :3] @ xyz.T).T + view.cam_from_world[:3, 3]
    small = (homogeneous / homogeneous[:, 2:]) @ view.K[:2].T
    seen = depth > 0
    assert np.allclose(small[seen], uv[seen] / factor, atol=1e-6)


def test_split_takes_every_eighth_by_name(room):
    train, test = load_split(room)
    names = sorted(image.name for image in room.images)
    assert [view.name for view in test] == names[::8]
    assert sorted(view.name for view in (*train, *test)) == names


def test_files_resized_beforehand_scale_the_intrinsics(room_path, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(room_path, copy)
    scene = load_scene(copy)
    path = copy / "images" / scene.images[0].name
    PilImage.open(path).resize((48, 36)).save(path)
    (view,) = load_views(scene, scene.images[:1])
    assert np.allclose(view.K[:2], scene.images[0].camera.K[:2] / 2)
    PilImage.open(path).resize((48, 48)).save(path)
    with pytest.raises(SceneFormatError, match="aspect ratio of its camera"):
        load_views(scene, scene.images[:1])


def test_distortion_is_refused(room):
    image = room.images[0]
    lens = Intrinsics(1, "SIMPLE_RADIAL", 96, 72, (80.0, 48.0, 36.0, 0.1))
    with pytest.raises(SceneFormatError, match="splatseed undistort"):
        load_views(room, [dataclasses.replace(image, intrinsics=lens)])
    straight = dataclasses.replace(lens, params=(80.0, 48.0, 36.0, 0.0))
    assert load_views(room, [dataclasses.replace(image, intrinsics=straight)])


def test_what_cannot_be_read_is_said(room, tmp_path):
    bad = tmp_path / "bad.png"
    bad.write_bytes(b"no image")
    with pytest.raises(SceneFormatError, match="to be an image"):
        load_photograph(bad)
    with pytest.raises(SceneNotFoundError, match="no such file"):
        load_photograph(tmp_path / "none.png")
    with pytest.raises(ParameterError, match="never enlarged"):
        load_photograph(bad, 0)
    with pytest.raises(SceneFormatError, match="smaller --data-factor"):
        load_views(room, room.images[:1], data_factor=9, min_side=11)
    with pytest.raises(SceneNotFoundError, match="at least two images"):
        load_split(room.replace(images=()))
