"""The words of errors in the spelling of the command line.

Methods and functions name their parameters as Python does, ``mls.disc_radius``; who typed
``--mls.disc-radius`` reads that instead.
"""

from __future__ import annotations

import re
from importlib import import_module

from splatseed.commands.options import known_options

FIELD = re.compile(r"(?<![\w./-])[a-z][a-z0-9]*(?:[_.][a-z0-9_]+)+(?!\.\w|[\w/-])")
PLAIN = re.compile(r"(?<=^expected )[a-z]+(?= (?:of|from|to be|between|above|below|at) )")
"""A name of one word is a name only where a range follows."""


def options_of(verb: str) -> list[str]:
    """All options of a verb."""
    if verb == "upsample":
        from splatseed.commands.upsample.command import HELP_ALL, full_options  # noqa: PLC0415

        return [*known_options(full_options()), HELP_ALL]
    return known_options(import_module(f"splatseed.commands.{verb}").Options)


def in_options(message: str, verb: str) -> str:
    """An error's message, with the names of parameters as the options of a verb.

    Example:
        >>> in_options("expected mls.disc_radius above 0; found 0.0.", "upsample")
        'expected --mls.disc-radius above 0; found 0.0.'
    """
    if not (FIELD.search(message) or PLAIN.search(message)):
        return message
    known = set(options_of(verb))

    def spelled(match: re.Match[str]) -> str:
        option = f"--{match[0].replace('_', '-')}"
        return option if option in known else match[0]

    return PLAIN.sub(spelled, FIELD.sub(spelled, message))
