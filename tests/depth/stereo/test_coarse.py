"""Scenes that no Structure-from-Motion has been at: stereo finds its own points, or takes depth
maps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.depth.stereo import pipeline, stereo_depths
from splatseed.depth.stereo.pipeline import MAP_SAMPLES, known_visibility
from splatseed.depthmap import DepthMap
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.visibility import find_visibility
from splatseed.pointcloud import PointCloud

from ..conftest import MemoryMaps
from .conftest import SETTINGS
from .made import arc, photograph, tilted_plane, true_depth


def bare(scene):
    return scene.replace(points=PointCloud.empty(), tracks=None)


@pytest.mark.parametrize("planted", ["plane", "ball"])
def test_maps_are_as_good_as_with_points_in_any_unit(planted, request):
    """Depth is sought in the cameras' own unit, as nobody knows the scene's."""
    made, unit = request.getfixturevalue(planted), 1000 if planted == "plane" else 1
    images = tuple(
        dataclasses.replace(i, translation=unit * i.translation) for i in made.scene.images
    )
    for i, found in enumerate(stereo_depths(bare(made.scene).replace(images=images), SETTINGS)):
        truth = true_depth(made.surfaces, made.stereo.map(i).camera)
        error = np.abs(found.depth / unit / truth - 1.0)[np.isfinite(found.depth)]
        assert found.known_fraction > 0.85 * made.stereo.map(i).known_fraction
        assert (error < 0.01).mean() > 0.85


@pytest.mark.parametrize("angles", [(0.0, 180.0), (0.0, 0.0, 0.0)], ids=["back to back", "at one"])
def test_views_without_parallax_have_empty_maps(angles, tmp_path):
    scene = bare(photograph(tmp_path, tilted_plane(0.0), arc(angles)))
    for stereo_map in stereo_depths(scene, SETTINGS):
        assert stereo_map.known_fraction == 0.0


@pytest.mark.parametrize("kind", ["z", "inverse"])
def test_depth_maps_replace_points(kind, plane):
    maps = MemoryMaps()
    for image in plane.scene.images[1:]:
        depth = true_depth(plane.surfaces, image.camera)
        maps[image.name] = DepthMap(depth.astype(np.float32), kind)
    visibility = known_visibility(bare(plane.scene).replace(depths=maps))
    if kind == "inverse":
        assert not len(visibility.xyz)  # its unit is nobody's
    else:
        assert len(visibility.xyz) == 4 * MAP_SAMPLES**2
        assert plane.surfaces.distance(visibility.xyz).max() < 1e-4


@pytest.mark.parametrize("enough", [True, False])
def test_points_are_used_if_half_of_the_images_see_enough(plane, enough, monkeypatch):
    seen = find_visibility(plane.scene)
    counts = [len(seen.rows_of(image)) for image in plane.scene.images]
    monkeypatch.setattr(pipeline, "MIN_SEEN", np.median(counts) + (not enough))
    maps = MemoryMaps({plane.scene.images[0].name: DepthMap(np.ones((80, 96), np.float32))})
    instead = known_visibility(plane.scene.replace(depths=maps))
    if enough:
        np.testing.assert_array_equal(instead.xyz, seen.xyz)
    else:
        assert len(instead.xyz) == MAP_SAMPLES**2
        assert not len(known_visibility(plane.scene).xyz)


def test_pairs_by_pose_look_the_same_way_from_another_place():
    cameras = arc((0.0, 5.0, 10.0, 15.0, 90.0, 0.0))
    chosen = choose_by_pose(np.stack([camera.cam_from_world for camera in cameras]), 3)
    assert set(chosen[0]) == {1, 2, 3}  # not 5, which stands where it stands, nor 4, beside
    assert (chosen[4] >= 0).all()  # which has none that look the same way, takes the most alike
    assert not (chosen == np.arange(len(cameras))[:, None]).any()
    film = arc(tuple(np.arange(20) * 0.5))  # frames that are too near each other are passed over
    chosen = choose_by_pose(np.stack([camera.cam_from_world for camera in film]), 5)
    assert set(np.abs(chosen[10] - 10)) <= {2, 3, 4, 5}
