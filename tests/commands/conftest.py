"""A small capture on disk, as the commands are given it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def room(larger_room_path) -> Path:
    """The path of the larger room, which the commands are given."""
    return larger_room_path


@pytest.fixture
def own_room(room, tmp_path) -> Path:
    """A copy of the room that a test may spoil."""
    return Path(shutil.copytree(room, tmp_path / "own"))
