"""The command line run in this process."""

from __future__ import annotations

from typing import NamedTuple

from splatseed.cli import main


class Run(NamedTuple):
    """What a command left: its exit code and all it said."""

    code: int
    out: str
    err: str


def exit_code(*words: object) -> int:
    """Run ``splatseed WORDS...``; only SystemExit may come out of it."""
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0
