"""Scenes that no Structure-from-Motion has been at: stereo finds its own points, or takes depth
maps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.depth.stereo import depths as without_points, stereo_depths
from splatseed.depth.stereo.depths import SAMPLES, coarse_stereo, known_visibility
from splatseed.depthmap import DepthMap
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.scene import Scene
from splatseed.views.pairs import choose_by_pose
from splatseed.views.view import load_views
from splatseed.views.visibility import find_visibility

from .conftest import SETTINGS
from .made import arc, photograph, relative_error, tilted_plane, true_depth


class Maps(dict):
    """Depth maps in memory."""

    def read(self, name: str) -> DepthMap:
        return self[name]


def bare(scene: Scene) -> Scene:
    none = PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))
    return scene.replace(points=none, tracks=None)


def test_a_glimpse_finds_points_on_the_surface(ball):
    points = coarse_stereo(load_views(ball.scene, ball.scene.images), 0, silent)
    assert len(points.xyz) > 100
    assert np.quantile(ball.surfaces.distance(points.xyz), 0.8) < 0.06


@pytest.mark.parametrize("planted", ["plane", "ball"])
def test_maps_are_as_good_as_with_points(planted, request):
    made = request.getfixturevalue(planted)
    for i, stereo_map in enumerate(stereo_depths(bare(made.scene), SETTINGS)):
        assert stereo_map.known_share > 0.85 * made.stereo.map(i).known_share
        assert (relative_error(made.surfaces, stereo_map) < 0.01).mean() > 0.85


def test_any_unit_of_length(plane):
    """Depth is sought in the cameras' own unit, as nobody knows the scene's."""
    images = tuple(
        dataclasses.replace(i, translation=1000 * i.translation) for i in plane.scene.images
    )
    big = stereo_depths(bare(plane.scene).replace(images=images), SETTINGS)
    for i, stereo_map in enumerate(big):
        truth = true_depth(plane.surfaces, plane.stereo.map(i).camera)
        error = np.abs(stereo_map.depth / 1000 / truth - 1.0)[np.isfinite(stereo_map.depth)]
        assert stereo_map.known_share > 0.6
        assert (error < 0.01).mean() > 0.85


def test_two_views(tmp_path):
    surfaces = tilted_plane()
    scene = bare(photograph(tmp_path, surfaces, arc((-4.0, 4.0))))
    for stereo_map in stereo_depths(scene, SETTINGS):
        assert stereo_map.known_share > 0.4
        assert (relative_error(surfaces, stereo_map) < 0.01).mean() > 0.8


@pytest.mark.parametrize("angles", [(0.0, 180.0), (0.0, 0.0, 0.0)])
def test_views_that_cannot_tell_depth_say_nothing(angles, tmp_path):
    """Back to back, or from one place."""
    scene = bare(photograph(tmp_path, tilted_plane(0.0), arc(angles)))
    for stereo_map in stereo_depths(scene, SETTINGS):
        assert stereo_map.known_share == 0.0


@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_depth_maps_stand_in_for_points(kind, plane):
    maps = Maps()
    for image in plane.scene.images:
        depth = true_depth(plane.surfaces, image.camera)
        if kind == "ray":
            row, column = np.indices(depth.shape) + 0.5
            K = image.camera.K
            depth = depth * np.hypot(
                np.hypot((column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]), 1
            )
        maps[image.name] = DepthMap(depth.astype(np.float32), kind)
    del maps[plane.scene.images[1].name]
    visibility = known_visibility(bare(plane.scene).replace(depths=maps))
    if kind == "inverse":
        assert not len(visibility.xyz)  # its unit is nobody's
    else:
        assert len(visibility.xyz) == 4 * SAMPLES**2
        assert plane.surfaces.distance(visibility.xyz).max() < 1e-4


@pytest.mark.parametrize("enough", [True, False])
def test_points_are_taken_where_half_of_the_images_see_enough(plane, enough, monkeypatch):
    seen = find_visibility(plane.scene)
    counts = [len(seen.rows_of(image)) for image in plane.scene.images]
    least = np.median(counts) + (0 if enough else 1)
    monkeypatch.setattr(without_points, "LEAST_SEEN", least)
    maps = Maps({plane.scene.images[0].name: DepthMap(np.ones((80, 96), np.float32))})
    instead = known_visibility(plane.scene.replace(depths=maps))
    if enough:
        np.testing.assert_array_equal(instead.xyz, seen.xyz)
    else:
        assert len(instead.xyz) == SAMPLES**2
        assert not len(known_visibility(plane.scene).xyz)


def test_pairs_by_pose_look_the_same_way_from_another_place():
    cameras = arc((0.0, 5.0, 10.0, 15.0, 90.0, 0.0))
    chosen = choose_by_pose(np.stack([camera.cam_from_world for camera in cameras]), 3)
    assert set(chosen[0]) == {1, 2, 3}  # not 5, which stands where it stands, nor 4, beside
    assert (chosen[4] >= 0).all()  # which has none that look the same way, takes the most alike
    assert not (chosen == np.arange(len(cameras))[:, None]).any()


def test_pairs_by_pose_pass_over_the_nearest():
    """Of a film, frames that are too near each other are not compared."""
    cameras = arc(tuple(np.arange(20) * 0.5))
    chosen = choose_by_pose(np.stack([camera.cam_from_world for camera in cameras]), 5)
    assert np.abs(chosen[10] - 10).min() >= 2
    assert np.abs(chosen[10] - 10).max() <= 5
