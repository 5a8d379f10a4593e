"""A small capture on disk, and the command line run in this process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from splatseed.cli import main


class Run(NamedTuple):
    """What a command left: its exit code and all it said."""

    code: int
    out: str
    err: str


@pytest.fixture(scope="session")
def room(larger_room_path) -> Path:
    """The path of the larger room, which the commands are given."""
    return larger_room_path


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
