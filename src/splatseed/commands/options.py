"""Parsing a command line into a verb's options.

Promise: tyro's complaints are raised as our errors, so that they end in one line like any other;
``--help`` still prints and exits.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from itertools import dropwhile, takewhile
from typing import Any, TypeVar

import tyro

from splatseed.errors import ParameterError
from splatseed.literal import did_you_mean

__all__ = ["known_options", "parse_options"]

Options = TypeVar("Options")

COLOR = re.compile(r"\x1b\[[0-9;]*m")
RULE = re.compile("[─-]{5,}")
DEFINED = re.compile(r"^(?:│ | {2})(-\S.*?)(?: {2}| ?│?$)", re.MULTILINE)
"""A line of tyro's help that defines options; help itself is indented further."""
OPTION = re.compile(r"(?<![\w-])--?[a-z](?:[\w.-]*\w)?(?![\w-])")
CHOICE = re.compile(
    r"invalid choice '([^']*)' for argument '([^']*)'.*?one of \(([^)]*)\)", re.IGNORECASE
)
NUMBER = re.compile(
    r"error parsing (\S+): (invalid literal for int|could not convert).*?'(.*?)'", re.IGNORECASE
)
TRIED = "Got errors:"
"""Marks the start of tyro's attempts to read a value, meant for its own developers."""


def parse_options(
    kind: type[Options], verb: str, arguments: Sequence[str], default: Options | None = None
) -> Options:
    """The options in ``arguments``.

    Args:
        kind: The dataclass that holds them.
        verb: The verb they belong to.
        arguments: The words after the verb.
        default: Values of options that are not given; the dataclass's own defaults if left out.

    Raises:
        ParameterError: An option is unknown, missing, or has an invalid value.
    """
    said = io.StringIO()
    given: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with redirect_stderr(said):
            options: Options = tyro.cli(kind, prog=f"splatseed {verb}", args=arguments, **given)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise _complaint(kind, verb, said.getvalue(), arguments) from None
    return options


def _complaint(kind: type[Any], verb: str, said: str, arguments: Sequence[str]) -> ParameterError:
    """Tyro's complaint as one of ours."""
    box = " ".join(COLOR.sub("", said).replace("│", " ").split())
    see = f"Run splatseed {verb} --help to see"
    if choice := CHOICE.search(box):
        word, option, names = choice[1], choice[2], re.findall(r"'([^']+)'", choice[3])
        names = sorted({*names} - {"None"})  # tyro's order changes; None is what is not given
        fix = did_you_mean(word, names).strip() or f"{see} what each is."
        return ParameterError(f"{option} as one of {', '.join(names)}", found=repr(word), fix=fix)
    if number := NUMBER.search(box):
        what = "a whole number" if "int" in number[2] else "a number"
        return ParameterError(f"{number[1]} as {what}", found=repr(number[3]), fix=f"{see} it.")
    return ParameterError(
        f"the options of splatseed {verb}",
        found=_sentence(said),
        fix=f"{_suggestion(kind, arguments)}{see} them.",
    )


def known_options(kind: type[Any]) -> list[str]:
    """All options of a dataclass's command line, such as ``--ratio`` and ``-o``."""
    shown = io.StringIO()
    with redirect_stdout(shown), suppress(SystemExit):
        tyro.cli(kind, args=["--help"])
    defined = DEFINED.findall(COLOR.sub("", shown.getvalue()))
    return sorted({option for line in defined for option in OPTION.findall(line)})


def _suggestion(kind: type[Any], arguments: Sequence[str]) -> str:
    """What the user may have meant by an unknown option; empty if unclear."""
    known = known_options(kind)
    unknown = [word.partition("=")[0] for word in arguments if word.startswith("--")]
    return next((did_you_mean(word, known) for word in unknown if word not in known), "")


def _sentence(box: str) -> str:
    """The text of one of tyro's boxes, in Unicode or ASCII, from its title to the next rule."""
    lines = [line.strip("│ ") for line in COLOR.sub("", box).splitlines()]
    below_title = dropwhile(RULE.fullmatch, [line for line in lines if line][1:])
    said = takewhile(lambda line: not RULE.fullmatch(line) and line != TRIED, below_title)
    words = " ".join(" ".join(said).split()).rstrip(".")
    return words[:1].lower() + words[1:]
