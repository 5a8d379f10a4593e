"""Undistorted photographs against a picture that is known along every ray."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.io import load_scene
from splatseed.lens import image_points
from splatseed.views.undistortion import undistort
from splatseed.views.view import load_views

WIDTH, HEIGHT = 96, 72
LENSES = [
    ("SIMPLE_RADIAL", (80.0, 48.0, 36.0, -0.2)),
    ("OPENCV", (80.0, 84.0, 47.0, 37.0, -0.2, 0.05, 0.004, -0.003)),
    ("OPENCV_FISHEYE", (60.0, 60.0, 48.0, 36.0, 0.02, -0.01, 0.0, 0.0)),
    ("FOV", (70.0, 70.0, 48.0, 36.0, 0.8)),
]


def lens_of(model, params):
    return Intrinsics(1, model, WIDTH, HEIGHT, params)


def rays_of(K, column, row):
    return np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]], axis=-1)


def painting(xy):
    """A smooth picture of the plane at depth 1."""
    x, y = xy[..., 0], xy[..., 1]
    waves = [np.sin(5 * x + 2 * y), np.cos(4 * y - x), np.sin(3 * x) * np.cos(3 * y)]
    return 127.5 + 120 * np.stack(waves, axis=-1)


def photograph(lens):
    """What the lens sees of the painting: rays of its pixels by fixed-point iteration."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    goal = np.stack([column, row], axis=-1)
    xy = rays_of(lens.K, column, row)
    for _ in range(200):
        xy = xy + 0.5 * (goal - image_points(lens, xy)) / lens.K[[0, 1], [0, 1]]
    assert np.abs(image_points(lens, xy) - goal).max() < 1e-6
    return np.rint(painting(xy)).astype(np.uint8)


@pytest.mark.parametrize(("model", "params"), LENSES)
def test_every_known_pixel_shows_what_lies_along_its_ray(model, params):
    lens = lens_of(model, params)
    pixels, known = undistort(photograph(lens), lens, lens.K)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = rays_of(lens.K, column, row)
    uv = image_points(lens, rays)
    assert np.array_equal(known, np.all((uv >= 0) & (uv <= [WIDTH, HEIGHT]), axis=-1))
    inner = np.all((uv >= 0.5) & (uv <= [WIDTH - 0.5, HEIGHT - 0.5]), axis=-1)
    assert np.abs(pixels - painting(rays))[inner].max() < 2  # two roundings, curvature of waves
    assert not pixels[~known].any()


def test_colours_are_interpolated_between_four_pixels(rng):
    """A literal loop over pixels."""
    lens = lens_of("OPENCV", (80.0, 84.0, 47.0, 37.0, 0.3, 0.05, 0.02, -0.01))
    source = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    pixels, known = undistort(source, lens, lens.K)
    padded = np.pad(source.astype(float), ((1, 1), (1, 1), (0, 0)), mode="edge")
    for i, j in np.ndindex(HEIGHT, WIDTH):
        u, v = image_points(lens, rays_of(lens.K, np.array(j + 0.5), np.array(i + 0.5)))
        if not (0 <= u <= WIDTH and 0 <= v <= HEIGHT):
            assert not known[i, j]
            assert not pixels[i, j].any()
            continue
        x, y = min(int(u + 0.5), WIDTH), min(int(v + 0.5), HEIGHT)
        a, b = u + 0.5 - x, v + 0.5 - y
        upper = (1 - a) * padded[y, x] + a * padded[y, x + 1]
        lower = (1 - a) * padded[y + 1, x] + a * padded[y + 1, x + 1]
        assert np.abs(pixels[i, j] - ((1 - b) * upper + b * lower)).max() <= 0.5 + 1e-9
    assert 0 < known.sum() < known.size


def test_what_a_fold_would_show_again_is_unknown():
    lens = lens_of("SIMPLE_RADIAL", (30.0, 48.0, 36.0, -0.3))
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    pixels, known = undistort(white, lens, lens.K)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = rays_of(lens.K, column, row)
    uv = image_points(lens, rays)
    assert np.all((uv > 0) & (uv < [WIDTH, HEIGHT]), axis=-1).all()  # all would show something
    distance = np.linalg.norm(rays, axis=-1)
    fold = np.sqrt(1 / 0.9)
    assert known[distance < 0.99 * fold].all()
    assert not known[distance > 1.01 * fold].any()
    assert np.array_equal(pixels[..., 0] == 255, known)


@pytest.fixture
def distorted(room_path, tmp_path):
    """The room with one photograph of a lens, of which a copy of half the size is on disk."""
    import shutil

    shutil.copytree(room_path, tmp_path / "copy")
    scene = load_scene(tmp_path / "copy")
    lens = lens_of(*LENSES[1])
    image = dataclasses.replace(scene.images[0], intrinsics=lens)
    half = PilImage.fromarray(photograph(lens)).reduce(2)
    half.save(tmp_path / "copy" / "images" / image.name)
    return scene.replace(images=(image, *scene.images[1:]))


def test_views_are_undistorted_where_that_is_asked_for(distorted):
    lens, straight = load_views(distorted, distorted.images[:2], undistort=True)
    assert lens.mask.shape == lens.photograph.shape[:2] == (HEIGHT // 2, WIDTH // 2)
    assert np.allclose(lens.K[:2], distorted.images[0].intrinsics.K[:2] / 2)
    column, row = np.meshgrid(np.arange(WIDTH // 2) + 0.5, np.arange(HEIGHT // 2) + 0.5)
    error = np.abs(lens.photograph - painting(rays_of(lens.K, column, row))).max(axis=-1)
    assert np.mean(error[lens.mask] < 5) > 0.95
    assert straight.mask is None
    (alone,) = load_views(distorted, distorted.images[1:2])
    assert np.array_equal(alone.photograph, straight.photograph)


def test_distortion_is_refused_where_it_is_not(distorted):
    with pytest.raises(SceneFormatError, match="without lens distortion"):
        load_views(distorted, distorted.images[:1])


def test_a_fisheye_without_coefficients_is_refused_too(room):
    lens = Intrinsics(1, "SIMPLE_RADIAL_FISHEYE", WIDTH, HEIGHT, (80.0, 48.0, 36.0, 0.0))
    with pytest.raises(SceneFormatError, match="without lens distortion"):
        load_views(room, [dataclasses.replace(room.images[0], intrinsics=lens)])
