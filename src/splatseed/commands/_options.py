"""The words of a command line, made into a verb's options.

Promise: what tyro finds wrong with them is raised as one of our errors, so that it ends in one line
like any other; ``--help`` still prints and exits.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import redirect_stderr
from itertools import dropwhile, takewhile
from typing import TypeVar

import tyro

from splatseed.errors import ParameterError

__all__ = ["parse_options"]

Options = TypeVar("Options")

COLOR = re.compile(r"\x1b\[[0-9;]*m")
RULE = re.compile("[─-]{5,}")
TRIED = "Got errors:"
"""What follows lists tyro's attempts to read a value, for its own developers."""


def parse_options(kind: type[Options], verb: str, arguments: Sequence[str]) -> Options:
    """The options in ``arguments``.

    Args:
        kind: The dataclass that holds them.
        verb: Whose they are.
        arguments: The words after the verb.

    Raises:
        ParameterError: An option is unknown, missing, or has a value that is none.
    """
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            return tyro.cli(kind, prog=f"splatseed {verb}", args=arguments)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ParameterError(
            f"the options of splatseed {verb}",
            found=_sentence(said.getvalue()),
            fix=f"Run splatseed {verb} --help to see them.",
        ) from None


def _sentence(box: str) -> str:
    """What a box of tyro's, drawn in Unicode or ASCII, says between its title and next rule."""
    lines = [line.strip("│ ") for line in COLOR.sub("", box).splitlines()]
    below_title = dropwhile(RULE.fullmatch, [line for line in lines if line][1:])
    said = takewhile(lambda line: not RULE.fullmatch(line) and line != TRIED, below_title)
    words = " ".join(" ".join(said).split()).rstrip(".")
    return words[:1].lower() + words[1:]
