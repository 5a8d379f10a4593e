"""Fits and the alignment of a scene's maps: what is recovered, what is left out, and why."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.depth.alignment import (
    align,
    align_map,
    least_squares_line,
    least_squares_scale,
    median_scale,
    ray_length,
    robust_line,
)
from splatseed.depthmap import DepthMap
from splatseed.views.visibility import camera_points, find_visibility


def planted(rng, num=300, outliers=0.2, noise=0.005):
    """Depths 1..6, with noise and gross outliers; values are still to be made of the clean ones."""
    clean = rng.uniform(1.0, 6.0, num)
    z = clean * (1.0 + noise * rng.normal(size=num))
    wrong = rng.permutation(num)[: int(outliers * num)]
    z[wrong] *= rng.choice([0.3, 0.5, 2.0, 3.0], len(wrong))
    return clean, z


def test_equation_7_is_a_loop_over_points(rng):
    value, z = rng.uniform(1.0, 5.0, (2, 40))
    best = min(
        (sum((s * d - t) ** 2 for d, t in zip(value, z, strict=True)), s)
        for s in np.linspace(0.2, 3.0, 28_001)
    )[1]
    numerator = denominator = 0.0
    for d, t in zip(value.tolist(), z.tolist(), strict=True):
        numerator += d * t
        denominator += d * d
    assert least_squares_scale(value, z) == pytest.approx(numerator / denominator, rel=1e-12)
    assert least_squares_scale(value, z) == pytest.approx(best, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [1e-3, 0.37, 5000.0])
def test_a_planted_scale_survives_outliers(seed, scale):
    clean, z = planted(np.random.default_rng(seed))
    assert median_scale(clean / scale, z) == pytest.approx(scale, rel=0.005)
    assert abs(least_squares_scale(clean / scale, z) / scale - 1) > 0.05


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("a", "b"), [(2.0, 0.1), (1e-3, -0.05), (0.5, 0.0)])
def test_a_planted_scale_and_shift_survive_outliers(seed, a, b):
    clean, z = planted(np.random.default_rng(seed))
    value = (1.0 / clean - b) / a
    scale, shift = robust_line(value, z)
    fitted = 1.0 / (scale * value + shift)
    assert scale == pytest.approx(a, rel=0.005)
    np.testing.assert_allclose(fitted, clean, rtol=0.005)
    plain = least_squares_line(value, z)
    assert abs(plain[0] / a - 1) > 0.02


def test_without_outliers_the_line_is_that_of_least_squares(rng):
    clean = rng.uniform(1.0, 6.0, 50)
    value = (1.0 / clean - 0.1) / 2.0
    for scale, shift in (robust_line(value, clean), least_squares_line(value, clean)):
        assert (scale, shift) == pytest.approx((2.0, 0.1), rel=1e-9)
    slope, intercept = np.polyfit(value, 1.0 / clean**1.1, 1)
    assert least_squares_line(value, clean**1.1) == pytest.approx((slope, intercept), rel=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(-20, 20))
@settings(max_examples=25, deadline=None)
def test_a_power_of_two_goes_through_exactly(seed, exponent):
    rng = np.random.default_rng(seed)
    value, z = rng.uniform(0.1, 9.0, (2, 30))
    factor = 2.0**exponent
    assert median_scale(value, z * factor) == factor * median_scale(value, z)
    assert least_squares_scale(value, z * factor) == factor * least_squares_scale(value, z)
    scale, shift = robust_line(value, z)
    assert robust_line(value, z * factor) == (scale / factor, shift / factor)


SCALES = 1.5 ** np.linspace(-3, 3, 12)


def with_outliers(scene, share=0.2):
    """The scene with some of its points moved far off."""
    rng = np.random.default_rng(5)
    xyz = scene.points.xyz.copy()
    wrong = rng.permutation(len(xyz))[: int(share * len(xyz))]
    xyz[wrong] += rng.normal(scale=2.0, size=(len(wrong), 3))
    tracks = scene.tracks
    return scene.replace(points=scene.points.replace(xyz=xyz), tracks=tracks)


def lengths(image):
    camera = image.camera
    return ray_length(camera, np.arange(camera.width), np.arange(camera.height)[:, None])


@pytest.mark.parametrize("tracked", [True, False], ids=["tracks", "projected"])
@pytest.mark.parametrize("kind", ["z", "ray"])
def test_a_planted_scale_of_every_image_is_found(kind, tracked, exact, make_maps):
    rays = [lengths(image) if kind == "ray" else 1.0 for image in exact.images]
    maps = make_maps(kind, lambda z, i: z * rays[i] / SCALES[i])
    scene = with_outliers(exact.replace(depths=maps))
    if not tracked:
        scene = scene.replace(tracks=None)
    alignments = align(scene, max_residual_ratio=None)
    assert list(alignments) == [image.name for image in exact.images]
    for alignment, scale in zip(alignments.values(), SCALES, strict=True):
        assert alignment.scale == pytest.approx(scale, rel=0.005)
        assert (alignment.shift, alignment.rejected) == (0.0, None)
        assert 0 < alignment.residual < 0.05


def test_a_planted_scale_and_shift_of_inverse_depth_are_found(exact, make_maps):
    maps = make_maps("inverse", lambda z, i: (1.0 / z - 0.02 * i) / SCALES[i])
    scene = with_outliers(exact.replace(depths=maps))
    for i, alignment in enumerate(align(scene, max_residual_ratio=None).values()):
        image, z = exact.images[i], 1.0 / (maps[exact.images[i].name].values * SCALES[i] + 0.02 * i)
        fitted = 1.0 / (maps[image.name].values * alignment.scale + alignment.shift)
        known = np.isfinite(z)
        assert np.median(np.abs(fitted[known] / z[known] - 1)) < 0.005
        assert alignment.scale == pytest.approx(SCALES[i], rel=0.02)


def test_a_point_takes_the_pixel_it_falls_into(exact):
    """Centres are at +0.5: on a map of noise, half a pixel to any side is another value
    altogether."""
    image, rng = exact.images[0], np.random.default_rng(0)
    values = rng.uniform(1.0, 5.0, (120, 160)).astype(np.float32)
    row, column = rng.integers(0, (120, 160), (200, 2)).T
    corner = np.stack([column, row], axis=1)
    for inside in (0.01, 0.3, 0.7, 0.99):
        xyz = image.camera.unproject(corner + inside, values[row, column])
        alignment = align_one(values, image.camera, xyz)
        assert (alignment.num_points, alignment.rejected) == (200, None)
        assert alignment.residual < 1e-6
        for dx, dy in ((0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5)):
            if not (0 < inside + dx < 1 and 0 < inside + dy < 1):
                off = image.camera.unproject(corner + inside + (dx, dy), values[row, column])
                assert align_one(values, image.camera, off).residual > 0.1


def align_one(values, camera, xyz):
    return align_map(DepthMap(values), camera, camera_points(camera, xyz), "robust", 20)


def test_images_are_left_out_for_a_reason(exact, make_maps):
    def change(z, i):
        if i == 0:
            return np.full_like(z, np.nan)
        if i == 1:
            return np.where(np.arange(z.shape[1]) < 3, z, np.nan)  # hardly any point there
        if i == 2:
            return z * np.random.default_rng(0).uniform(0.2, 3.0, z.shape)
        if i == 3:
            return z * np.random.default_rng(0).uniform(0.9, 1.1, z.shape)
        return z

    alignments = list(align(exact.replace(depths=make_maps("z", change))).values())
    reasons = [alignment.rejected for alignment in alignments]
    assert reasons[0] == "the map has no depth at any pixel"
    assert "SfM points see depth; 20 are needed" in reasons[1]
    assert "at half of the SfM points" in reasons[2]
    assert "typically" in reasons[3]
    assert set(reasons[4:]) == {None}
    kept = list(
        align(exact.replace(depths=make_maps("z", change)), max_residual_ratio=None).values()
    )
    assert kept[3].rejected is None


def test_depth_given_for_its_inverse_is_refused(exact, make_maps):
    alignments = align(exact.replace(depths=make_maps("inverse")))
    assert all("rise with depth" in alignment.rejected for alignment in alignments.values())
    alignments = align(exact.replace(depths=make_maps("z", lambda z, _: 1 / z))).values()
    good = align(exact).values()
    assert np.median([a.residual for a in alignments]) > 10 * np.median([a.residual for a in good])


def test_of_points_that_hide_each_other_the_nearest_counts(exact):
    image = exact.images[0]
    camera = image.camera
    uv = np.array([[80.2, 60.3], [80.4, 60.1], [20.0, 20.0]])
    xyz = camera.unproject(uv, np.array([2.0, 5.0, 5.0])).astype(np.float32)
    behind = camera.unproject(uv[:1], np.array([-1.0])).astype(np.float32)
    points = type(exact.points)(np.concatenate([xyz, behind]), np.zeros((4, 3), np.uint8))
    seen = find_visibility(exact.replace(points=points, tracks=None)).of(image)
    np.testing.assert_allclose(seen, xyz[[0, 2]], rtol=1e-6)
