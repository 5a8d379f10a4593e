"""A small capture."""

from __future__ import annotations

import pytest

from splatseed.io import load_scene
from splatseed.synthetic import make_capture, write_capture


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """A COLMAP scene of 9 views of 96 x 72."""
    path = tmp_path_factory.mktemp("room") / "room"
    return load_scene(write_capture(make_capture(0, num_views=9, width=96, height=72), path))
