"""A made room, on disk and in memory, with photographs large enough to be compared."""

from __future__ import annotations

import pytest

from splatseed.io import load_scene
from splatseed.scene import Scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.views.view import load_views


@pytest.fixture(scope="session")
def room_capture():
    """16 photographs of 160 x 120, and the surfaces they show."""
    return make_capture(0, num_views=16, width=160, height=120)


@pytest.fixture(scope="session")
def room(tmp_path_factory, room_capture) -> Scene:
    """The same, read from disk."""
    return load_scene(write_capture(room_capture, tmp_path_factory.mktemp("room") / "room"))


@pytest.fixture(scope="session")
def room_views(room):
    """Its photographs as views."""
    return load_views(room, room.images)
