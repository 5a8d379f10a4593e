"""Values that formats allow and no capture has: each gets its own true message."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.alignment import align_map
from splatseed.depthmap import DepthMap
from splatseed.io.cleaning import clean_scene
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.upsample import upsample
from splatseed.views.visibility import camera_points


def test_a_depth_map_of_one_value(model):
    image = model.images[0]
    camera = image.camera
    uv = np.array([[x, y] for x in range(50, 600, 50) for y in range(50, 400, 50)], np.float64)
    seen = camera_points(camera, camera.unproject(uv, np.linspace(2, 5, len(uv))))
    depth = DepthMap(np.full((480, 640), 3.0, np.float32), "z")
    assert "one value" in align_map(depth, camera, seen, "robust", 20).rejected
    depth.values[0, 0] = 2.0
    assert align_map(depth, camera, seen, "robust", 20).rejected is None


def _cloud(rng, *far):
    xyz = rng.normal(size=(500, 3)).astype(np.float32)
    xyz[: len(far)] = np.reshape(far, (-1, 1))
    return PointCloud(xyz, np.zeros((500, 3), np.uint8))


@pytest.mark.parametrize("method", ["mls", "linear", "spline", "voronoi", "triangle"])
def test_a_point_beyond_all_distances_is_left_out(method, rng):
    cloud = _cloud(rng, 1e30)
    clean = clean_scene(Scene(cloud))
    assert clean.warnings == ("1 point is beyond 1e15 and was left out.",)
    assert len(clean.points) == 499
    new = upsample(cloud, method, num_points=800).xyz[500:]
    assert np.abs(new).max() < 10
