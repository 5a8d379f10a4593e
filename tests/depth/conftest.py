"""A ray-cast room whose depth is exact, on disk and in memory."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depthmap import DepthMap
from splatseed.io import load_scene
from splatseed.synthetic import make_capture, write_capture


class MemoryMaps(dict):
    """Depth maps in memory, by image name."""

    def read(self, name):
        return self[name]


@pytest.fixture(scope="session")
def capture():
    """The demo's room, small: 12 views of 160 x 120."""
    return make_capture(0, num_views=12, width=160, height=120)


@pytest.fixture(scope="session")
def exact(capture, tmp_path_factory):
    """Its scene, read from disk, with the exact planar depth of every image in memory."""
    folder = write_capture(capture, tmp_path_factory.mktemp("depth") / "room")
    return load_scene(folder).replace(depths=maps_of(capture))


def maps_of(capture, kind="z", change=lambda z, _: z):
    """The capture's exact depth, as maps of a kind, changed image by image."""
    maps = MemoryMaps()
    for i, (image, depth) in enumerate(zip(capture.scene.images, capture.depths, strict=True)):
        z = np.where(depth > 0, depth, np.nan).astype(np.float64)
        maps[image.name] = DepthMap(change(z, i).astype(np.float32), kind)
    return maps


@pytest.fixture(scope="session")
def make_maps(capture):
    """Makes maps of the room: ``make_maps(kind, change)``."""
    return lambda kind="z", change=lambda z, _: z: maps_of(capture, kind, change)
