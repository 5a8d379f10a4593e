"""A ray-cast room whose depth is exact, on disk and in memory."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.alignment import ray_length
from splatseed.depthmap import DepthMap
from splatseed.io import load_scene


class MemoryMaps(dict):
    """Depth maps in memory, by image name."""

    def read(self, name):
        return self[name]


@pytest.fixture(scope="session")
def capture(room_of):
    """The demo's room, small: 12 views of 160 x 120."""
    return room_of(12, 160, 120).capture


@pytest.fixture(scope="session")
def make_maps(capture):
    """Makes maps of the room: ``make_maps(kind, change)``, which takes planar depth and the image's
    number, and gives planar depth, or the inverse."""

    def make(kind="z", change=lambda z, _: z):
        maps = MemoryMaps()
        for i, (image, depth) in enumerate(zip(capture.scene.images, capture.depths, strict=True)):
            z = change(np.where(depth > 0, depth, np.nan).astype(np.float64), i)
            if kind == "ray":
                z = z * ray_length(image.camera, np.arange(160), np.arange(120)[:, None])
            maps[image.name] = DepthMap(z.astype(np.float32), kind)
        return maps

    return make


@pytest.fixture(scope="session")
def exact(room_of, make_maps):
    """Its scene, read from disk, with the exact planar depth of every image in memory."""
    return load_scene(room_of(12, 160, 120).path).replace(depths=make_maps())
