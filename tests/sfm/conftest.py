"""The room to reconstruct, whose poses and surfaces are known."""

from __future__ import annotations

import pytest

from splatseed.io import load_scene
from splatseed.synthetic import make_capture, write_capture


@pytest.fixture(scope="session")
def capture():
    """The room in 12 views of 320 x 240."""
    return make_capture(0, num_views=12, width=320, height=240)


@pytest.fixture(scope="session")
def room(capture, tmp_path_factory):
    """The same on disk, with its true poses. Not to be written to."""
    return load_scene(write_capture(capture, tmp_path_factory.mktemp("sfm") / "room"))
