"""The command line run in this process."""

from __future__ import annotations

import re
import warnings
from argparse import ArgumentParser
from typing import Any, NamedTuple

import tyro

from splatseed.cli import main
from splatseed.commands.options import CONFIG, with_reporting

EXPECTED = re.compile(r"^(?:note: .*|.*\n(?:  -> .*\n?)+)\n?", re.MULTILINE)
"""Notes and plans on stderr."""


class Run(NamedTuple):
    """What a command left: its exit code and all it said."""

    code: int
    out: str
    err: str

    @property
    def unexpected(self) -> str:
        """What is on stderr besides notes and plans."""
        return EXPECTED.sub("", self.err)


def exit_code(*words: object) -> int:
    """Run ``splatseed WORDS...``; only SystemExit may come out of it."""
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def parser_of(kind: type[Any]) -> ArgumentParser:
    """A dataclass's command line as argparse has it, whose options can be listed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return tyro.extras.get_parser(with_reporting(kind), config=CONFIG)


def options_of(kind: type[Any]) -> list[str]:
    """All options of a dataclass's command line, such as ``--ratio``; ``-o`` is ``--output``."""
    names = (each.option_strings[-1:] for each in parser_of(kind)._actions)
    return [option for each in names for option in each if option != "--help"]
