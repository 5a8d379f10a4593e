"""A made room on disk, with photographs large enough to be compared."""

from __future__ import annotations

import pytest

from splatseed.io import load_scene
from splatseed.scene import Scene
from splatseed.synthetic import make_capture, write_capture


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Scene:
    """16 photographs of 160 x 120."""
    path = tmp_path_factory.mktemp("room") / "room"
    return load_scene(write_capture(make_capture(0, num_views=16, width=160, height=120), path))


@pytest.fixture(scope="session")
def room_capture():
    """What the room was photographed from: its surfaces are known."""
    return make_capture(0, num_views=16, width=160, height=120)
