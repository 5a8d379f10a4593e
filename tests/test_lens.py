"""Lenses against pycolmap's, by inversion, and where they fold."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.lens import distort, fold_radius, project_rays, unproject_pixels


def make_lens(model, rng, size=0.03):
    """A lens of a model with moderate distortion."""
    info = CAMERA_MODELS[model]
    pinhole = ((50.0, 55.0) if info.num_focal == 2 else (50.0,)) + (32.0, 24.0)
    rest = rng.normal(scale=size, size=info.num_params - len(pinhole))
    rest = {"FOV": (0.7,), "EUCM": (0.6, 1.2)}.get(model, rest)
    return Intrinsics(1, model, 64, 48, (*pinhole, *rest))


@pytest.fixture(params=CAMERA_MODELS)
def lens(request, rng):
    return make_lens(request.param, rng)


@pytest.fixture
def rays(rng):
    """Places within some 45 degrees of the axis, and the axis itself."""
    return np.concatenate([np.zeros((1, 2)), rng.uniform(-0.8, 0.8, (200, 2))])


def test_pixels_match_pycolmap(lens, rays):
    pycolmap = pytest.importorskip("pycolmap", reason="the reference for camera models")
    camera = pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=list(lens.params)
    )
    expected = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(project_rays(lens, rays), expected, atol=1e-10)


def test_unproject_inverts_project_rays(lens, rays):
    np.testing.assert_allclose(unproject_pixels(lens, project_rays(lens, rays)), rays, atol=1e-7)
    grid = rays[:200].reshape(20, 10, 2)
    assert unproject_pixels(lens, project_rays(lens, grid)).shape == grid.shape
    assert unproject_pixels(lens, np.empty((0, 2))).shape == (0, 2)


def test_pixels_beyond_the_fold_have_no_ray():
    """u = x - x^3 / 10 grows up to x = 1.83, where it is 1.22."""
    lens = Intrinsics(1, "SIMPLE_RADIAL", 64, 48, (50.0, 32.0, 24.0, -0.1))
    u = np.array([0.0, 0.5, 1.2, 1.23, 5.0, 1e6])
    x, y = unproject_pixels(lens, np.stack([32 + 50 * u, 24 + 0 * u], axis=-1)).T
    np.testing.assert_allclose(x[:3] - x[:3] ** 3 / 10, u[:3], atol=1e-9)
    assert (x[:3] < 1.83).all()
    np.testing.assert_allclose(y[:3], 0, atol=1e-9)
    assert np.isnan(x[3:]).all()


@pytest.mark.parametrize("model", [name for name in CAMERA_MODELS if "FISHEYE" not in name])
def test_without_coefficients_a_lens_is_a_pinhole(model, rng, rays):
    lens = make_lens(model, rng)
    zeros = len(lens.params) - CAMERA_MODELS[model].num_focal - 2
    straight = Intrinsics(1, model, 64, 48, (*lens.params[: -zeros or None], *[0.0] * zeros))
    np.testing.assert_array_equal(distort(straight, rays), rays)
    assert not straight.has_distortion
    assert lens.has_distortion == (zeros > 0)


def test_a_division_model_has_a_largest_ray():
    """r = s / (1 + k s^2) is largest, 1 / (2 sqrt k), where s = 1 / sqrt k."""
    lens = Intrinsics(1, "SIMPLE_DIVISION", 64, 48, (50.0, 32.0, 24.0, 0.25))
    s = distort(lens, np.array([0.99, 0.0]))[0]
    assert s / (1 + 0.25 * s**2) == pytest.approx(0.99)
    assert np.isnan(distort(lens, np.array([1.01, 0.0]))).all()
    assert fold_radius(lens, 3.0) == pytest.approx(1.0, abs=3 / 500)


def test_the_fold_is_at_the_largest_image_radius():
    """r (1 + k r^2) turns back at r = sqrt(-1 / 3k)."""
    lens = Intrinsics(1, "SIMPLE_RADIAL", 64, 48, (50.0, 32.0, 24.0, -0.3))
    assert fold_radius(lens, 2.0) == pytest.approx(np.sqrt(1 / 0.9), abs=2.0 / 500)
    assert fold_radius(lens, 1.0) == 1.0
    opening = Intrinsics(1, "SIMPLE_RADIAL", 64, 48, (50.0, 32.0, 24.0, 0.3))
    assert fold_radius(opening, 5.0) == 5.0
