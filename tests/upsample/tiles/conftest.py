"""Clouds in tiles, and the same in memory."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.runtime.tasks import HereTasks
from splatseed.scene import Scene
from splatseed.upsample.tiles import Request, TilePlan, make_tiled, open_work, scene_source


class Tiles:
    """Upsamples clouds in tiles in a folder of the test's."""

    def __init__(self, path):
        self.path = path

    def __call__(self, cloud, name, method, *, most=60, ratio=3, seed=0, at_once=97, tasks=None):
        """Positions and colours of all points."""
        scene = cloud if isinstance(cloud, Scene) else Scene(cloud)
        source, request = scene_source(scene), Request(name, method, ratio, None, seed)
        plan = TilePlan(most, at_once, None, None, 0)
        with open_work(self.path, request.job(source)) as self.resumed:
            self.tiled = make_tiled(self.path, source, request, plan, tasks or HereTasks(), silent)
            pieces = [*self.tiled.originals(silent), *self.tiled.new(silent)]
        return tuple(np.concatenate(arrays) for arrays in zip(*pieces, strict=True))


@pytest.fixture
def tiles(tmp_path):
    return Tiles(tmp_path / "OUT.tiles")


@pytest.fixture(scope="session")
def sheet():
    """400 points of a noisy sheet with outliers, among them repeats and one that is not finite."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.0, 1.0, (2, 400))
    z = 0.2 * np.sin(3.0 * x) + 0.01 * rng.normal(size=400)
    z[::50] += 1.5
    xyz = np.stack([x, y, z], axis=1).astype(np.float32)
    xyz[150:180] = xyz[:30]
    xyz[77, 1] = np.nan
    return PointCloud(xyz, rng.integers(0, 256, (400, 3), np.uint8))
