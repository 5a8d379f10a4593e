"""The demo's capture must be exact where it is truth, and like SfM where it is measurement."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PillowImage

from splatseed.io import find_depths, load_scene
from splatseed.synthetic import DEPTH_SCALE, make_capture, write_capture
from splatseed.synthetic.room import visible


@pytest.fixture(scope="module")
def capture(room_of):
    return room_of(16, 160, 120).capture


def test_depth_unprojects_onto_the_surfaces(capture):
    for image, depth in zip(capture.scene.images, capture.depths, strict=True):
        row, column = (each[::5] for each in np.nonzero(depth))
        uv = np.stack([column, row], axis=1) + 0.5
        z = depth[row, column].astype(np.float64)
        distance = capture.surfaces.distance(image.camera.unproject(uv, z))
        assert (distance / z).max() < 1e-6


def residuals(scene, xyz):
    """How far each observation is from where its point is seen, and the point of each."""
    tracks = scene.tracks
    point_idx = np.repeat(np.arange(len(tracks)), tracks.lengths)
    off = np.empty(len(point_idx))
    for image in scene.images:
        mine = tracks.image_ids == image.image_id
        uv, depth = image.camera.project(xyz[point_idx[mine]])
        assert (depth > 0).all()
        off[mine] = np.linalg.norm(uv - image.observations.xy[tracks.point2d_idx[mine]], axis=1)
    return off, point_idx


def test_reprojection_errors_are_those_of_the_observations(capture):
    tracks = capture.scene.tracks
    off, point_idx = residuals(capture.scene, tracks.xyz)
    mean = np.bincount(point_idx, off) / tracks.lengths
    np.testing.assert_allclose(mean, tracks.errors, atol=1e-9)
    assert 0.3 < np.median(mean) < 0.9


def test_inliers_are_near_the_surfaces_and_mismatches_are_not(capture):
    distance = capture.surfaces.distance(capture.scene.tracks.xyz)
    errors, lengths = capture.scene.tracks.errors, capture.scene.tracks.lengths
    bad = capture.outliers
    assert 0.01 < bad.mean() < 0.05
    assert np.median(distance[~bad]) < 0.01
    assert np.median(distance[bad]) > 10 * np.median(distance[~bad])
    assert errors[bad].mean() > 1.3 * errors[~bad].mean()
    assert lengths[bad].max() <= 3 <= lengths[~bad].min()


def test_a_seed_gives_the_same_capture_and_another_seed_another():
    first, again, other = (make_capture(seed, 4, 64, 48) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.images, again.images)
    np.testing.assert_array_equal(first.depths, again.depths)
    np.testing.assert_array_equal(first.scene.tracks.xyz, again.scene.tracks.xyz)
    assert (first.images != other.images).any()


def test_visible_samples_are_on_surfaces_and_seen(capture, rng):
    samples = capture.sample_visible(3000, rng)
    assert samples.shape == (3000, 3)
    assert capture.surfaces.distance(samples).max() < 1e-9
    seen = np.any(
        [visible(capture.surfaces, i.camera, samples) for i in capture.scene.images], axis=0
    )
    assert seen.all()
    inside_pot = np.hypot(samples[:, 0] + 0.62, samples[:, 1] - 0.10) < 0.2
    assert not (inside_pot & (samples[:, 2] < 0.01)).any()  # the floor under the flower pot


def test_a_written_capture_loads_as_the_same_scene(capture, tmp_path):
    path = write_capture(capture, tmp_path / "room")
    scene = load_scene(path)
    assert scene.findings == ()
    np.testing.assert_array_equal(scene.points.xyz, capture.scene.points.xyz)
    np.testing.assert_array_equal(scene.tracks.xyz, capture.scene.tracks.xyz)
    np.testing.assert_array_equal(scene.tracks.image_ids, capture.scene.tracks.image_ids)
    assert [image.name for image in scene.images] == [i.name for i in capture.scene.images]
    maps = find_depths(scene, path)  # needs no scale: depths.json tells it
    for image, picture, depth in zip(scene.images, capture.images, capture.depths, strict=True):
        np.testing.assert_array_equal(_read(path / "images" / image.name), picture)
        written = _read(path / "depths" / image.name) / DEPTH_SCALE
        np.testing.assert_allclose(written, depth, atol=0.51 / DEPTH_SCALE)
        read = maps.read(image.name).values
        np.testing.assert_allclose(read[depth > 0], depth[depth > 0], atol=0.51 / DEPTH_SCALE)
        assert np.isnan(read[depth == 0]).all()


def _read(path):
    with PillowImage.open(path) as file:
        return np.asarray(file)
