"""A made room with photographs large enough to be compared."""

from __future__ import annotations

import pytest

from splatseed.photos.loading import load_views


@pytest.fixture(scope="session")
def room_capture(sixteen_views):
    """16 photographs of 160 x 120, and the surfaces they show."""
    return sixteen_views[0]


@pytest.fixture(scope="session")
def room(sixteen_views):
    """The same, read from disk."""
    return sixteen_views[1]


@pytest.fixture(scope="session")
def room_views(room):
    """Its photographs as views."""
    return load_views(room, room.images)
