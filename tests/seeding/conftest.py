"""A made room, on disk and in memory, with photographs large enough to be compared."""

from __future__ import annotations

import pytest

from splatseed.io import load_scene
from splatseed.scene import Scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.views.view import View


@pytest.fixture(scope="session")
def room(tmp_path_factory, room_capture) -> Scene:
    """16 photographs of 160 x 120."""
    return load_scene(write_capture(room_capture, tmp_path_factory.mktemp("room") / "room"))


@pytest.fixture(scope="session")
def room_capture():
    """What the room was photographed from: its surfaces are known."""
    return make_capture(0, num_views=16, width=160, height=120)


@pytest.fixture(scope="session")
def room_views(room_capture):
    """Its photographs as views."""
    cameras = (image.camera for image in room_capture.scene.images)
    return [
        View(f"{k}", pixels, c.K, c.width, c.height, c.cam_from_world)
        for k, (pixels, c) in enumerate(zip(room_capture.images, cameras, strict=True))
    ]
