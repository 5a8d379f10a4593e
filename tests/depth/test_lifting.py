"""Lifted points against surfaces that are known, against the text, and against the settings."""

from __future__ import annotations

import os

import numpy as np
import pytest

import splatseed as ss
from splatseed.depth import lifting, views
from splatseed.depth.alignment import PlanarDepth, lift_pixels, ray_length

FLOAT32 = 3e-6  # metres, in a room of 5


def lifted(scene, num, profile="default", **changes):
    """Only the new points."""
    seeds = ss.upsample(
        scene, "depth", num_points=len(scene.points) + num, profile=profile, **changes
    )
    assert len(seeds) == len(scene.points) + num
    assert set(seeds.source[len(scene.points) :]) == {6}
    return seeds.select(slice(len(scene.points), None))


def along_rays(scene, make_maps):
    """The same depth as distances along the rays."""

    def change(z, i):
        camera = scene.images[i].camera
        columns, rows = np.arange(camera.width), np.arange(camera.height)[:, None]
        return z * ray_length(camera, columns, rows)

    return scene.replace(depths=make_maps("ray", change))


@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_lifted_points_lie_on_the_surfaces(kind, exact, capture, make_maps):
    scene = exact
    if kind == "ray":
        scene = along_rays(exact, make_maps)
    if kind == "inverse":
        scene = exact.replace(depths=make_maps("inverse", lambda z, _: 1 / z))
    new = lifted(scene, 5000, align=False)
    assert capture.surfaces.distance(new.xyz.astype(np.float64)).max() < FLOAT32
    aligned = lifted(scene, 5000)  # SfM points are off by millimetres
    assert np.median(capture.surfaces.distance(aligned.xyz.astype(np.float64))) < 0.002


def test_equation_9_is_a_loop_over_pixels(exact, rng):
    image = exact.images[0]
    camera, depth = image.camera, exact.depths.read(image.name)
    pixel = rng.choice(np.flatnonzero(depth.values > 0), 50, replace=False)
    scale = 1.7
    for unit_ray in (False, True):
        planar = PlanarDepth.of(depth, camera, scale, 0.0, unit_ray=unit_ray)
        lifted = lift_pixels(pixel, planar.at(pixel), camera, np.empty((50, 3), np.float32))
        for number, point in zip(pixel.tolist(), lifted, strict=True):
            v, u = number // 160 + 0.5, number % 160 + 0.5
            ray = camera.cam_from_world[:3, :3].T @ np.linalg.inv(camera.K) @ [u, v, 1.0]
            if unit_ray:
                ray /= np.sqrt(sum(x * x for x in ray))
            d = float(depth.values[number // 160, number % 160])
            np.testing.assert_allclose(point, camera.center + scale * d * ray, atol=FLOAT32)


def test_colors_are_those_of_the_pixels(exact, capture):
    new = lifted(exact, 4000, align=False)
    seen = np.zeros(4000, bool)
    for image, pixels in zip(exact.images, capture.images, strict=True):
        uv, z = image.camera.project(new.xyz)
        inside = (z > 0) & ((uv >= 0) & (uv < (160, 120))).all(axis=1)
        column, row = np.floor(uv[inside]).astype(int).T
        centred = np.abs(uv[inside] - np.floor(uv[inside]) - 0.5).max(axis=1) < 1e-3
        same = (pixels[row, column] == new.rgb[inside]).all(axis=1)
        seen[np.flatnonzero(inside)[centred & same]] = True
    assert seen.all()  # each is the centre of a pixel of its colour in some image


def test_the_paper_takes_as_many_from_the_middle_of_every_image(exact):
    new = lifted(exact, 1203, "paper", unit_ray=False, align=False)
    middle = np.zeros(12, int)
    for i, (image, part) in enumerate(zip(exact.images, np.array_split(new.xyz, 12), strict=True)):
        uv, _ = image.camera.project(part)  # points come image after image
        middle[i] = ((uv > (40, 30)) & (uv < (120, 90))).all(axis=1).sum()
    assert sorted(middle) == [100] * 9 + [101] * 3


@pytest.mark.parametrize("profile", ["default", "paper"])
def test_bytes_follow_from_the_seed_whatever_the_threads(profile, exact, monkeypatch):
    results = []
    for cores in (1, 2, 7):
        monkeypatch.setattr(os, "cpu_count", lambda cores=cores: cores)
        new = lifted(exact, 3000, profile, seed=3)
        results.append(new.xyz.tobytes() + new.rgb.tobytes())
    assert len(set(results)) == 1
    assert lifted(exact, 3000, profile, seed=4).xyz.tobytes() not in results[0]


def test_held_out_images_are_not_even_read(exact):
    class Watched(dict):
        def read(self, name):
            names.add(name)
            return self[name]

    names = set()
    scene = exact.replace(depths=Watched(exact.depths))
    lifted(scene, 200, hold_out=8)
    test_names = {image.name for image in scene.split(8)[1]}
    assert names == {image.name for image in scene.images} - test_names


def test_a_second_reading_comes_when_the_first_was_not_enough(exact, make_maps, monkeypatch):
    """Each map is off by its own tenth, unaligned: hardly a candidate is confirmed."""
    reads = []
    plain = views.Reader.read

    def counted(self, image, num, rng):
        reads.append(num)
        return plain(self, image, num, rng)

    monkeypatch.setattr(views.Reader, "read", counted)
    scale = 1 + 0.06 * np.sin(np.arange(12) * 2.0)
    scene = exact.replace(depths=make_maps("z", lambda z, i: z * scale[i]))
    notes = []
    lifted(scene, 3000, align=False, note=notes.append)
    assert len(set(reads)) > 1
    assert max(reads) <= lifting.MAX_OVERSAMPLING * 3000 / 12 + 1
    assert any("confirmed by fewer than 2 other views" in note for note in notes)


def test_every_pixel_can_be_had_but_no_more(exact):
    scene = exact.replace(images=exact.images[:2])
    pixels = sum(int((exact.depths.read(im.name).values > 0).sum()) for im in scene.images)
    options = {"min_agreeing": 0, "see_through": True, "edge_tolerance": None}
    new = lifted(scene, pixels, **options)
    assert len(np.unique(new.xyz, axis=0)) == pixels
    for profile, change in (("default", options), ("paper", {"region": 1.0})):
        with pytest.raises(ss.errors.PointCloudError, match=rf"give {pixels + 1:,}.*{pixels:,}"):
            lifted(scene, pixels + 1, profile, **change)


def test_without_points_metric_depth_will_do(exact, capture):
    empty = exact.replace(points=exact.points.select(slice(0)), tracks=None)
    seeds = ss.upsample(empty, "depth", num_points=1500, align=False)
    assert len(seeds) == 1500
    assert capture.surfaces.distance(seeds.xyz.astype(np.float64)).max() < FLOAT32
    with pytest.raises(ss.errors.ParameterError, match="num_points of 1 or more"):
        ss.upsample(empty, "depth", ratio=4, align=False)
    with pytest.raises(ss.errors.PointCloudError, match="at least one original"):
        ss.upsample(empty, "depth", num_points=1500)
