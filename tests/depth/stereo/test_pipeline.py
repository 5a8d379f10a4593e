"""Depth and normals of planted surfaces, and of captures that stereo can say little about."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import pytest

import splatseed as ss
from splatseed.depth.stereo import pipeline, stereo_depths
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.pipeline import find_stereo
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.photos.loading import load_views
from splatseed.photos.visibility import find_visibility
from splatseed.pointcloud import PointCloud

from .conftest import SETTINGS
from .made import (
    GREY,
    HEIGHT,
    WIDTH,
    arc,
    degrees_off,
    photograph,
    relative_error,
    tilted_plane,
    true_depth,
    true_normals,
)


def maps_of(planted):
    return [planted.stereo.map(i) for i in range(len(planted.stereo.views))]


def test_a_tilted_plane(plane):
    for stereo_map in maps_of(plane):
        error = relative_error(plane.surfaces, stereo_map)
        angle = degrees_off(plane.surfaces, stereo_map)
        assert stereo_map.known_fraction > 0.7
        assert (error < 0.01).mean() > 0.95
        assert np.median(error) < 0.003
        assert np.median(angle) < 6
        assert np.quantile(angle, 0.9) < 15


def test_a_ball_before_a_wall(ball):
    for stereo_map in maps_of(ball):
        error = relative_error(ball.surfaces, stereo_map)
        angle = degrees_off(ball.surfaces, stereo_map)
        assert stereo_map.known_fraction > 0.55
        assert (error < 0.01).mean() > 0.9
        assert np.median(angle) < 10


def test_fields_of_a_map_are_consistent(ball):
    for image, stereo_map in zip(ball.scene.images, maps_of(ball), strict=True):
        known = np.isfinite(stereo_map.depth)
        assert stereo_map.name == image.name
        assert known.shape == (HEIGHT // SETTINGS.grid, WIDTH // SETTINGS.grid)
        assert (stereo_map.camera.height, stereo_map.camera.width) == known.shape
        np.testing.assert_array_equal(np.isfinite(stereo_map.normal).all(axis=-1), known)
        np.testing.assert_array_equal(stereo_map.confidence > 0, known)
        assert (np.bitwise_count(stereo_map.agreeing[known]) >= SETTINGS.min_agreeing).all()
        assert not stereo_map.agreeing[~known].any()
        assert set(stereo_map.sources) == {other.name for other in ball.scene.images} - {
            stereo_map.name
        }
        rays = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in known.shape[::-1])), axis=-1)
        rays = np.concatenate([rays, np.ones((*known.shape, 1))], axis=-1)
        towards = (rays @ np.linalg.inv(stereo_map.camera.K).T * stereo_map.normal).sum(axis=-1)
        assert (towards[known] < 0).all()


def test_points_are_the_known_pixels_with_the_photographs_colours(ball):
    for view, stereo_map in zip(ball.stereo.views, maps_of(ball), strict=True):
        points = stereo_map.points()
        known = np.isfinite(stereo_map.depth)
        assert len(points) == known.sum()
        uv, z = stereo_map.camera.project(points.xyz.astype(float))
        np.testing.assert_allclose(z, stereo_map.depth[known], rtol=1e-5)
        row, column = np.floor(uv).astype(int).T[::-1]
        np.testing.assert_array_equal(np.stack([row, column]), np.nonzero(known))
        blocks = view.photograph.reshape(known.shape[0], 2, known.shape[1], 2, 3)
        np.testing.assert_allclose(points.rgb, blocks.mean(axis=(1, 3))[known], atol=0.5)
        assert np.quantile(ball.surfaces.distance(points.xyz.astype(float)), 0.9) < 0.04


def test_maps_give_the_method_depth_its_depths(plane):
    """As the documentation writes it."""
    maps = ss.stereo_depths(plane.scene, grid=2)
    scene = plane.scene.with_depths(maps)
    seeds = ss.upsample(scene, "depth", ratio=4)
    new = seeds.xyz[seeds.source != 0].astype(float)
    assert len(new) == 3 * len(scene.points)
    assert np.quantile(plane.surfaces.distance(new), 0.95) < 0.02
    assert plane.scene.depths is None


def test_a_map_keeps_its_camera_where_its_grid_does_not_divide_the_photograph(plane):
    maps = ss.stereo_depths(plane.scene, grid=7)
    depths = plane.scene.with_depths(maps).depths
    for image, stereo_map in zip(plane.scene.images, maps, strict=True):
        camera = depths.read(image.name).camera(image.camera)
        np.testing.assert_array_equal(camera.K, stereo_map.camera.K)
        assert (camera.width, camera.height) == (WIDTH // 7, HEIGHT // 7)


def test_confidence_is_higher_where_depth_is_right(ball):
    right, confidence = [], []
    for stereo_map in maps_of(ball):
        right.append(relative_error(ball.surfaces, stereo_map) < 0.005)
        confidence.append(stereo_map.confidence[np.isfinite(stereo_map.depth)])
    right, confidence = np.concatenate(right), np.concatenate(confidence)
    assert confidence[right].mean() > confidence[~right].mean()


def test_bytes_do_not_depend_on_threads(ball, monkeypatch):
    before = numba.get_num_threads()
    monkeypatch.setattr(pipeline, "MIN_SEEN", 1)  # so that priors are its points
    try:
        for threads in (1, 2):
            monkeypatch.setattr("splatseed.progress.available_cpus", lambda n=threads: n)
            numba.set_num_threads(min(threads, before))
            for old, new in zip(maps_of(ball), stereo_depths(ball.scene, SETTINGS), strict=True):
                for field in ("depth", "normal", "confidence", "agreeing"):
                    assert getattr(old, field).tobytes() == getattr(new, field).tobytes()
    finally:
        numba.set_num_threads(before)


def test_another_seed_gives_other_bytes_of_equal_quality(plane):
    stereo_map = stereo_depths(plane.scene, SETTINGS, seed=1)[0]
    assert stereo_map.depth.tobytes() != maps_of(plane)[0].depth.tobytes()
    assert (relative_error(plane.surfaces, stereo_map) < 0.01).mean() > 0.95


def test_two_views_confirm_each_other(tmp_path):
    surfaces = tilted_plane()
    scene = photograph(tmp_path, surfaces, arc((-4.0, 4.0)))
    for stereo_map in stereo_depths(scene, SETTINGS):
        assert stereo_map.known_fraction > 0.5
        assert (relative_error(surfaces, stereo_map) < 0.01).mean() > 0.9


@pytest.mark.parametrize("num", [0, 1])
def test_stereo_needs_two_photographs(num, tmp_path):
    scene = photograph(tmp_path, tilted_plane(), arc((0.0,)))
    with pytest.raises(SceneNotFoundError, match=str(num)):
        stereo_depths(scene.replace(images=scene.images[:num]))


def test_views_without_overlap_have_empty_maps(tmp_path):
    front, back = arc((0.0, 180.0))
    scene = photograph(tmp_path, tilted_plane(0.0), [front, back])
    for stereo_map in stereo_depths(scene, SETTINGS):
        assert stereo_map.known_fraction == 0.0
        assert not stereo_map.confidence.any()


def test_textureless_walls_have_no_depth(tmp_path):
    scene = photograph(tmp_path, tilted_plane(), arc(), texture=GREY)
    for stereo_map in stereo_depths(scene, SETTINGS):
        assert stereo_map.known_fraction < 0.02


def test_views_of_different_sizes_and_lenses(tmp_path):
    surfaces = tilted_plane()
    cameras = [*arc((0.0, 8.0)), *arc((-8.0, 14.0), (70, 90), 80.0), *arc((-14.0,), (120, 64), 120)]
    scene = photograph(tmp_path, surfaces, cameras)
    for stereo_map, camera in zip(stereo_depths(scene, SETTINGS), cameras, strict=True):
        assert stereo_map.depth.shape == (camera.height // 2, camera.width // 2)
        assert stereo_map.known_fraction > 0.5
        assert (relative_error(surfaces, stereo_map) < 0.01).mean() > 0.9


def test_a_view_smaller_than_its_grid_has_an_empty_map(tmp_path):
    cameras = [*arc((0.0, 6.0)), *arc((-6.0,), (20, 16), 20.0)]
    scene = photograph(tmp_path, tilted_plane(), cameras)
    maps = stereo_depths(scene, StereoSettings(grid=20))
    assert [stereo_map.depth.shape for stereo_map in maps] == [(4, 4), (4, 4), (0, 1)]


@pytest.mark.parametrize("shift", [0.0, -50.0])
def test_points_at_and_behind_the_cameras(shift, tmp_path):
    """A third of the points is moved to where no camera can see them; tracks or not."""
    surfaces = tilted_plane()
    scene = photograph(tmp_path, surfaces, arc((0.0, 7.0, -7.0)))
    xyz = scene.points.xyz.copy()
    xyz[:30] = scene.images[0].camera.center + np.array([0, 0, shift], np.float32)
    moved = scene.replace(points=PointCloud(xyz, scene.points.rgb))
    for stereo_map in stereo_depths(moved, SETTINGS):
        assert stereo_map.known_fraction > 0.5
        assert (relative_error(surfaces, stereo_map) < 0.01).mean() > 0.9


def test_the_ground_truth_satisfies_the_planes_equation(plane):
    """The truth of the made plane, by its equation: normal . x = 0."""
    for stereo_map in maps_of(plane):
        depth = true_depth(plane.surfaces, stereo_map.camera)
        row, column = np.indices(depth.shape).reshape(2, -1)
        uv = np.stack([column, row], axis=1) + 0.5
        xyz = stereo_map.camera.unproject(uv, depth.ravel())
        normals = true_normals(plane.surfaces, stereo_map.camera).reshape(-1, 3)
        assert (
            np.abs((xyz * (normals @ stereo_map.camera.cam_from_world[:3, :3])).sum(axis=1)).max()
            < 1e-6
        )


@pytest.mark.parametrize(
    "changes",
    [
        {"max_size": 31}, {"grid": 0}, {"grid": 33}, {"sweeps": 0}, {"num_sources": 9},
        {"num_sources": 0}, {"num_check_views": 9}, {"min_agreeing": 0}, {"min_agreeing": 9},
        {"tolerance": 0.0}, {"max_cost": 0.0}, {"max_cost": 2.1},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(changes):
    with pytest.raises(ParameterError, match=next(iter(changes))):
        StereoSettings(**changes)


def test_maps_of_some_views_equal_those_of_all(ball):
    scene, only = ball.scene, [3, 0]
    views = load_views(scene, scene.images)
    settings = dataclasses.replace(SETTINGS, num_check_views=2)
    every = find_stereo(views, scene.images, find_visibility(scene), settings)
    some = find_stereo(views, scene.images, find_visibility(scene), settings, only=only)
    for i in only:
        assert some.map(i).depth.tobytes() == every.map(i).depth.tobytes()
        assert some.map(i).normal.tobytes() == every.map(i).normal.tobytes()
    assert sum(np.isfinite(cost).any() for cost in some.costs) < len(views)
