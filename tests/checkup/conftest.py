"""A made room with photographs large enough to be compared."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def room(sixteen_views):
    """16 photographs of 160 x 120 of the room, read from disk."""
    return sixteen_views[1]


@pytest.fixture(autouse=True)
def _check_anew(check_anew):
    """The check-up is the subject."""
