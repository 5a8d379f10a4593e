"""Descriptors of shapes that are known, free of units, and kept."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatseed.bench.analysis.descriptors import (
    Descriptors,
    describe,
    read_descriptors,
    write_descriptors,
)
from splatseed.camera import Camera, Intrinsics, quat_from_rotation
from splatseed.errors import PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource


def cloud(xyz):
    return PointCloud(xyz.astype(np.float32), np.zeros((len(xyz), 3), np.uint8))


def plane(rng, n=4000):
    return np.column_stack([rng.uniform(-1, 1, (n, 2)), np.zeros(n)])


def shape(name, rng, n=4000):
    return {
        "plane": plane(rng, n),
        "line": np.column_stack([np.linspace(-1, 1, n), np.zeros((n, 2))]),
        "ball": rng.standard_normal((n, 3)),
    }[name]


@pytest.mark.parametrize(("name", "most"), [("plane", "planarity"), ("line", "linearity")])
def test_a_plane_is_planar_and_a_line_linear(rng, name, most):
    described = describe(Scene(cloud(shape(name, rng))))
    values = {k: getattr(described, k) for k in ("planarity", "linearity", "scattering")}
    assert max(values, key=values.get) == most
    assert described.scattering == pytest.approx(0, abs=1e-6)
    assert described.curvature == pytest.approx(0, abs=1e-6)
    assert described.planarity + described.linearity + described.scattering == pytest.approx(1)


def test_a_ball_scatters(rng):
    described = describe(Scene(cloud(shape("ball", rng))))
    assert described.scattering > 0.25
    assert described.curvature > 0.12


def test_local_shape_against_a_slow_reference(rng):
    xyz = rng.standard_normal((60, 3)).astype(np.float32).astype(float)
    total = []
    for point in xyz:
        near = xyz[np.argsort(np.linalg.norm(xyz - point, axis=1))[:17]]
        l3, l2, l1 = np.linalg.eigvalsh(np.cov(near.T, bias=True))
        total.append(((l2 - l3) / l1, (l1 - l2) / l1, l3 / l1, l3 / (l1 + l2 + l3)))
    described = describe(Scene(cloud(xyz)))
    values = (described.planarity, described.linearity, described.scattering, described.curvature)
    assert values == pytest.approx(np.mean(total, axis=0), rel=1e-5)


def test_units_and_frames_do_not_matter(rng):
    xyz = shape("ball", rng, 500)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    here, there = (describe(Scene(cloud(each))) for each in (xyz, 50 * xyz @ turn + 7))
    for name in ("planarity", "linearity", "scattering", "curvature", "unevenness"):
        assert getattr(here, name) == pytest.approx(getattr(there, name), rel=1e-3)


def test_uneven_spacing_shows(rng):
    even = describe(Scene(cloud(plane(rng))))
    mixed = np.concatenate([plane(rng), 0.02 * plane(rng) + 5])
    assert describe(Scene(cloud(mixed))).unevenness > 2 * even.unevenness


def photograph(path, pixels):
    from PIL import Image as PilImage

    PilImage.fromarray(pixels).save(path)


def view(folder, xyz, pixels, name="a.png"):
    """A camera 4 above the origin that looks down on it, and its photograph."""
    camera = Intrinsics(1, "PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
    pose = np.diag([1.0, -1.0, -1.0])
    image = Image(name, 1, camera, quat_from_rotation(pose), np.array([0.0, 0.0, 4.0]))
    photograph(folder / name, pixels)
    source = SceneSource("colmap", folder, folder, image_dir=folder)
    return Scene(cloud(xyz), (image,), (camera,), source=source)


def test_gaps_and_empty_area_are_those_of_the_views(tmp_path, rng):
    xyz = plane(rng, 500)
    flat = np.full((48, 64, 3), 128, np.uint8)
    described = describe(view(tmp_path, xyz, flat))
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    spacing = np.sort(distance, axis=1)[:, 1:7].mean(axis=1)
    # All is 4 away: f h / z over the longer side.
    assert described.gap == pytest.approx(np.median(spacing) * 60 / 4 / 64, rel=1e-3)
    assert 0.4 < described.empty < 0.8  # the square fills 30 x 30 of 64 x 48 pixels
    assert described.texture == 0
    half = describe(view(tmp_path, xyz[xyz[:, 0] > 0], flat))
    assert half.empty > described.empty


def test_texture_is_the_mean_gradient(tmp_path, rng):
    ramp = np.ascontiguousarray(np.broadcast_to(np.arange(64)[None, :, None] * 4, (48, 64, 3)))
    described = describe(view(tmp_path, plane(rng, 50), ramp.astype(np.uint8)))
    # 64 pixels are made 320: a fifth of 4 / 255 a pixel.
    assert described.texture == pytest.approx(4 / 5 / 255, rel=0.1)
    noise = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    assert describe(view(tmp_path, plane(rng, 50), noise)).texture > 3 * described.texture


def test_points_that_were_added_are_not_described(rng):
    xyz = plane(rng, 300)
    both = np.concatenate([xyz, rng.standard_normal((900, 3))]).astype(np.float32)
    source = np.repeat(np.array([0, 4], np.uint8), [300, 900])
    added = PointCloud(both, np.zeros((1200, 3), np.uint8), source)
    assert describe(Scene(added)) == pytest.approx(describe(Scene(cloud(xyz))), nan_ok=True)


def test_bare_clouds_have_no_pictures_and_few_points_are_refused(rng):
    described = describe(Scene(cloud(plane(rng, 30))))
    assert all(math.isnan(each) for each in (described.gap, described.empty, described.texture))
    with pytest.raises(PointCloudError, match="at least 4"):
        describe(Scene(cloud(np.ones((20, 3)))))


def test_kept_descriptors_come_back(tmp_path):
    kept = {"ab": Descriptors(0.1, 0.2, 0.3, 0.4, math.nan, 0.6, 0.7, math.nan)}
    path = tmp_path / "descriptors.json"
    write_descriptors(path, kept)
    read = read_descriptors(path)
    assert read["ab"].planarity == 0.1
    assert math.isnan(read["ab"].texture)


@pytest.mark.parametrize("text", ["", "[]", '{"schema": 9, "scenes": {}}', '{"schema": 1}',
                                  '{"schema": 1, "scenes": {"a": {"planarity": 1}}}'])  # fmt: skip
def test_what_cannot_be_used_is_taken_anew(tmp_path, text):
    path = tmp_path / "descriptors.json"
    assert read_descriptors(path) == {}
    path.write_text(text, "utf-8")
    assert read_descriptors(path) == {}


def test_a_camera_is_what_the_view_says(tmp_path, rng):
    camera = view(tmp_path, plane(rng, 9), np.zeros((48, 64, 3), np.uint8)).images[0].camera
    assert isinstance(camera, Camera)
    assert camera.project(np.zeros((1, 3)))[1] == pytest.approx([4.0])
