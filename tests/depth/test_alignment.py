"""Fits and the alignment of a scene's maps: what is recovered, what is left out, and why."""

from __future__ import annotations

import re

import numpy as np
import pytest

from splatseed.depth.alignment import (
    PlanarDepth,
    align_map,
    align_maps,
    least_squares_line,
    least_squares_scale,
    median_scale,
    ray_length,
    robust_line,
)
from splatseed.depthmap import DepthMap
from splatseed.photos.visibility import find_visibility, points_in_image

SCALES = 1.5 ** np.linspace(-3, 3, 12)


def planted(rng, num=300, outliers=0.2, noise=0.005):
    """Depths 1..6, with noise and gross outliers; values are still to be made of the clean ones."""
    clean = rng.uniform(1.0, 6.0, num)
    z = clean * (1.0 + noise * rng.normal(size=num))
    wrong = rng.permutation(num)[: int(outliers * num)]
    z[wrong] *= rng.choice([0.3, 0.5, 2.0, 3.0], len(wrong))
    return clean, z


def test_equation_7_equals_a_loop_over_points(rng):
    value, z = rng.uniform(1.0, 5.0, (2, 40))
    numerator = denominator = 0.0
    for d, t in zip(value.tolist(), z.tolist(), strict=True):
        numerator += d * t
        denominator += d * d
    assert least_squares_scale(value, z) == pytest.approx(numerator / denominator, rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("a", "b"), [(2.0, 0.1), (1e-3, -0.05), (0.5, 0.0)])
def test_robust_line_recovers_scale_and_shift_despite_outliers(seed, a, b):
    clean, z = planted(np.random.default_rng(seed))
    assert median_scale(clean / a, z) == pytest.approx(a, rel=0.005)
    assert abs(least_squares_scale(clean / a, z) / a - 1) > 0.05
    value = (1.0 / clean - b) / a
    scale, shift = robust_line(value, z)
    assert scale == pytest.approx(a, rel=0.005)
    np.testing.assert_allclose(1.0 / (scale * value + shift), clean, rtol=0.005)
    assert abs(least_squares_line(value, z)[0] / a - 1) > 0.02


def test_without_outliers_the_robust_line_is_least_squares(rng):
    clean = rng.uniform(1.0, 6.0, 50)
    value = (1.0 / clean - 0.1) / 2.0
    assert robust_line(value, clean) == pytest.approx((2.0, 0.1), rel=1e-9)
    slope, intercept = np.polyfit(value, 1.0 / clean**1.1, 1)
    assert least_squares_line(value, clean**1.1) == pytest.approx((slope, intercept), rel=1e-9)


def with_outliers(scene, share=0.2):
    """The scene with some of its points moved far off."""
    rng = np.random.default_rng(5)
    xyz = scene.points.xyz.copy()
    wrong = rng.permutation(len(xyz))[: int(share * len(xyz))]
    xyz[wrong] += rng.normal(scale=2.0, size=(len(wrong), 3))
    return scene.replace(points=scene.points.replace(xyz=xyz), tracks=scene.tracks)


@pytest.mark.parametrize("tracked", [True, False], ids=["tracks", "projected"])
@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_alignment_recovers_the_scale_of_each_image(kind, tracked, exact, make_maps):
    def change(z, i):
        if kind == "inverse":
            return (1.0 / z - 0.02 * i) / SCALES[i]
        return z / SCALES[i]

    maps = make_maps(kind, change)
    scene = with_outliers(exact.replace(depths=maps))
    if not tracked:
        scene = scene.replace(tracks=None)
    alignments = align_maps(scene, max_residual_ratio=None)
    assert list(alignments) == [image.name for image in exact.images]
    for image, found, scale in zip(exact.images, alignments.values(), SCALES, strict=True):
        assert found.rejected is None
        assert found.scale == pytest.approx(scale, rel=0.02 if kind == "inverse" else 0.005)
        assert 0 < found.residual < 0.05
        unit = {"unit_ray": False}
        planar = PlanarDepth.from_map(
            maps[image.name], image.camera, found.scale, found.shift, **unit
        )
        z = exact.depths.read(image.name).values
        assert np.nanmedian(np.abs(planar.full() / z - 1)) < 0.005


def test_a_point_takes_the_value_of_its_pixel(exact):
    """Centres are at +0.5: on a map of noise, half a pixel to any side is another value
    altogether."""
    image, rng = exact.images[0], np.random.default_rng(0)
    values = rng.uniform(1.0, 5.0, (120, 160)).astype(np.float32)
    row, column = rng.integers(0, (120, 160), (200, 2)).T
    corner = np.stack([column, row], axis=1)

    def align_at(uv):
        points = points_in_image(image.camera, image.camera.unproject(uv, values[row, column]))
        return align_map(DepthMap(values), image.camera, points, "robust", 20)

    for inside in (0.01, 0.3, 0.7, 0.99):
        alignment = align_at(corner + inside)
        assert (alignment.num_points, alignment.rejected) == (200, None)
        assert alignment.residual < 1e-6
        for dx, dy in ((0.5, 0.0), (0.0, 0.5), (-0.5, 0.0), (0.0, -0.5)):
            if not (0 < inside + dx < 1 and 0 < inside + dy < 1):
                assert align_at(corner + inside + (dx, dy)).residual > 0.1


def test_rejected_images_have_a_reason(exact, make_maps):
    def change(z, i):
        noise = np.random.default_rng(0)
        if i == 0:
            return np.full_like(z, np.nan)
        if i == 1:
            return np.where(np.arange(z.shape[1]) < 3, z, np.nan)  # hardly any point there
        if i == 2:
            return z * noise.uniform(0.2, 3.0, z.shape)
        if i == 4:
            return np.full_like(z, 3.0)
        return z * noise.uniform(0.9, 1.1, z.shape) if i == 3 else z

    scene = exact.replace(depths=make_maps("z", change))
    reasons = [alignment.rejected for alignment in align_maps(scene).values()]
    assert None not in reasons[:5]
    assert len(set(reasons[:5])) == 5  # a reason of its own for each
    assert "20" in reasons[1]  # the points that are needed
    assert all(re.search(r"\d%", reason) for reason in reasons[2:4])  # by how much
    assert set(reasons[5:]) == {None}
    assert list(align_maps(scene, max_residual_ratio=None).values())[3].rejected is None


def test_depth_read_as_inverse_depth_is_rejected(exact, make_maps):
    alignments = align_maps(exact.replace(depths=make_maps("inverse", lambda z, _: z)))
    assert all(alignment.rejected for alignment in alignments.values())
    alignments = align_maps(exact.replace(depths=make_maps("z", lambda z, _: 1 / z))).values()
    good = align_maps(exact).values()
    assert np.median([a.residual for a in alignments]) > 10 * np.median([a.residual for a in good])


def test_occluded_points_do_not_count(exact):
    image = exact.images[0]
    uv = np.array([[80.2, 60.3], [80.4, 60.1], [20.0, 20.0], [80.2, 60.3]])
    xyz = image.camera.unproject(uv, np.array([2.0, 5.0, 5.0, -1.0])).astype(np.float32)
    points = type(exact.points)(xyz, np.zeros((4, 3), np.uint8))
    seen = find_visibility(exact.replace(points=points, tracks=None)).of(image)
    np.testing.assert_allclose(seen, xyz[[0, 2]], rtol=1e-6)


@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_planar_depth_of_each_kind(kind, exact):
    camera = exact.images[0].camera
    z = 3.0 + np.linspace(0, 1, 120 * 160).reshape(120, 160)
    length = ray_length(camera, np.arange(160), np.arange(120)[:, None])
    assert length[60, 80] == pytest.approx(
        np.linalg.norm(np.linalg.inv(camera.K) @ [80.5, 60.5, 1])
    )
    values = {"z": z / 2, "ray": z * length / 2, "inverse": (1 / z - 0.1) / 2}[kind]
    shift = 0.1 if kind == "inverse" else 0.0
    depth = DepthMap(values.astype(np.float32), kind)
    planar = PlanarDepth.from_map(depth, camera, 2.0, shift, unit_ray=False)
    np.testing.assert_allclose(planar.full(), z, rtol=2e-6)
    np.testing.assert_allclose(planar.strided(1, 3) * planar.scale, z[1::3, 1::3], rtol=2e-6)
    np.testing.assert_allclose(planar.at_pixels(np.array([0, 166])), [z[0, 0], z[1, 6]], rtol=2e-6)
    behind = DepthMap(np.full((120, 160), -1.0, np.float32), "inverse")
    assert np.isnan(PlanarDepth.from_map(behind, camera, 1.0, 0.5, unit_ray=False).full()).all()
