"""A small capture on disk, and the command line run in this process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from splatseed.cli import main
from splatseed.synthetic import make_capture, write_capture


class Run(NamedTuple):
    """What a command left: its exit code and all it said."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """A COLMAP scene of the procedural room: 12 images, about 460 points. Not to be written to."""
    path = tmp_path_factory.mktemp("room") / "room"
    return write_capture(make_capture(0, num_views=12, width=120, height=90), path)


@pytest.fixture
def own_room(room, tmp_path) -> Path:
    """A copy of the room that a test may spoil."""
    return Path(shutil.copytree(room, tmp_path / "own"))


@pytest.fixture
def splatseed(capsys) -> Callable[..., Run]:
    """Runs ``splatseed WORDS...``; only SystemExit may come out of it."""

    def run(*words: object) -> Run:
        capsys.readouterr()
        code = 0
        try:
            main([str(word) for word in words])
        except SystemExit as stop:
            code = int(stop.code or 0)
        return Run(code, *capsys.readouterr())

    return run
