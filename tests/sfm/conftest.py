"""The room to reconstruct, whose poses and surfaces are known."""

from __future__ import annotations

import pytest

from splatseed.io import load_scene


@pytest.fixture(scope="session")
def capture(room_of):
    """The room in 12 views of 256 x 192."""
    return room_of(12, 256, 192).capture


@pytest.fixture(scope="session")
def room(room_of):
    """The same on disk, with its true poses. Not to be written to."""
    return load_scene(room_of(12, 256, 192).path)
