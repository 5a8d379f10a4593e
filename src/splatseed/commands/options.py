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
from splatseed.literal import agreeing, did_you_mean

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
UNION = re.compile(
    r"error parsing (\S+): no type matching (\S+) could.*?from \['(.*?)'\]", re.IGNORECASE
)
"""A value that is none of several kinds: ``FLOAT|{gcv}``."""
SHORT = re.compile(r"(\d+\.?\d*)([km])", re.IGNORECASE)
"""A number such as 500k or 1.5M."""
SYNONYMS = {"gpu": "cuda"}
"""Words for choices that look more like other choices."""
VALUE = re.compile(r"missing value for argument '([^']*)'", re.IGNORECASE)
REQUIRED = "Missing from"
"""Marks the start of tyro's list of required options: each below a step of 4 spaces, its help
below 8."""
TRIED = "Got errors:"
"""Marks the start of tyro's attempts to read a value, meant for its own developers."""


def parse_options(
    kind: type[Options],
    verb: str,
    arguments: Sequence[str],
    default: Options | None = None,
    page: str | None = None,
) -> Options:
    """The options in ``arguments``.

    Args:
        kind: The dataclass that holds them.
        verb: The verb they belong to.
        arguments: The words after the verb.
        default: Values of options that are not given; the dataclass's own defaults if left out.
        page: The words with which ``--help`` shows the options, if not only the verb.

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
        raise _complaint(kind, verb, said.getvalue(), arguments, page or verb) from None
    return options


def check_least(options: object, least: float, *names: str) -> None:
    """Refuse numbers that are too small; None, for an option that is not given, is none.

    Args:
        options: The parsed options.
        least: The least value.
        names: The fields to check.

    Raises:
        ParameterError: One is smaller, or no number.
    """
    for name in names:
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise ParameterError(
                f"{name} of {least:g} or more",  # spelled as an option in the end
                found=f"{value}",
                fix="Leave it out for the default.",
            )


def _complaint(
    kind: type[Any], verb: str, said: str, arguments: Sequence[str], page: str
) -> ParameterError:
    """Tyro's complaint as one of ours."""
    box = " ".join(COLOR.sub("", said).replace("│", " ").split())
    see = f"Run splatseed {page} --help to see"
    if (bad := _bad_value(box, see)) is not None:
        return bad
    known = known_options(kind)
    # Before what is missing: tyro can take an unknown option for the end of the values.
    if unknown := _unknown(arguments, known):
        meant = next(filter(None, (did_you_mean(word, known) for word in unknown)), "")
        options = "option" if len(unknown) == 1 else "options"
        return _unfit(verb, f"unrecognized {options} {', '.join(unknown)}", f"{meant}{see}")
    if value := VALUE.search(box):
        return ParameterError(f"a value for {value[1]}", found="none", fix=f"{see} it.")
    if missing := _missing(said):
        found = {1: "none", 2: "neither"}.get(len(missing), "none of them")
        fix = f"{see} {'it' if len(missing) == 1 else 'them'}."
        return ParameterError(", and ".join(missing), found=found, fix=fix)
    if more := re.fullmatch(r"unrecognized options: (.+)", sentence := _sentence(said)):
        what = agreeing(len(more[1].split()), "a word that belongs", "words that belong")
        return _unfit(verb, f"{what} to none: {more[1]}", see)
    return _unfit(verb, sentence, see)


def _bad_value(box: str, see: str) -> ParameterError | None:
    """A complaint about the value of one option."""
    if choice := CHOICE.search(box):
        word, option = choice[1], choice[2]
        # Tyro's order changes; None is what is not given.
        names = sorted({*re.findall(r"'([^']+)'", choice[3])} - {"None"})
        what = f"one of {', '.join(names)}"
        fix = did_you_mean(SYNONYMS.get(word.lower(), word), names) or f"{see} what each is."
    elif union := UNION.search(box):
        option, kinds, word = union[1], union[2].split("|"), union[3]
        names = [each.strip("{}") for each in kinds if each.startswith("{")]
        what = " or ".join([*("a number" for each in kinds if each.isupper()), *names])
        fix = did_you_mean(word, names) or f"{see} it."
    elif number := NUMBER.search(box):
        option, word = number[1], number[3]
        what = "a whole number" if "int" in number[2] else "a number"
        meant = SHORT.fullmatch(word)  # as budgets, which have no fixed unit, are written
        fix = f"Did you mean {_in_full(*meant.groups())}?" if meant else f"{see} it."
    else:
        return None
    return ParameterError(f"{option} as {what}", found=repr(word), fix=fix.strip())


def _in_full(digits: str, unit: str) -> str:
    return f"{float(digits) * {'k': 1e3, 'm': 1e6}[unit.lower()]:.0f}"


def _unfit(verb: str, found: str, see: str) -> ParameterError:
    return ParameterError(f"the options of splatseed {verb}", found=found, fix=f"{see} them.")


def known_options(kind: type[Any]) -> list[str]:
    """All options of a dataclass's command line, such as ``--ratio`` and ``-o``."""
    shown = io.StringIO()
    with redirect_stdout(shown), suppress(SystemExit):
        tyro.cli(kind, args=["--help"])
    defined = DEFINED.findall(COLOR.sub("", shown.getvalue()))
    return sorted({option for line in defined for option in OPTION.findall(line)})


def _unknown(arguments: Sequence[str], known: Sequence[str]) -> list[str]:
    """The options among the words that are not known."""
    names = [word.partition("=")[0] for word in arguments]
    return [name for name in names if OPTION.fullmatch(name.lower()) and _dashed(name) not in known]


def _dashed(name: str) -> str:
    """An option's name as the help shows it; tyro takes underscores for dashes."""
    return name[:2] + name[2:].replace("_", "-")


def _missing(box: str) -> list[str]:
    """The required options that are missing: ``-o PATH, the folder of the run``."""
    lines = [line[2:].rstrip(" │") for line in COLOR.sub("", box).splitlines()]
    listed = dropwhile(lambda line: not line.startswith(REQUIRED), lines)
    missing: list[list[str]] = []
    for line in takewhile(lambda line: not RULE.fullmatch(line), listed):
        if line.startswith(" " * 8):
            missing[-1].append(line.strip())
        elif line.startswith(" " * 4):
            missing.append([line.strip().partition(",")[0]])
    return [f"{name}, {_clause(' '.join(does))}" for name, *does in missing]


def _clause(text: str) -> str:
    """The first sentence of a help text, as a part of another."""
    first = re.split(r"\.(?=\s|$)", text)[0]
    return first if first[1:2].isupper() else first[:1].lower() + first[1:]


def _sentence(box: str) -> str:
    """The text of one of tyro's boxes, in Unicode or ASCII, from its title to the next rule."""
    lines = [line.strip("│ ") for line in COLOR.sub("", box).splitlines()]
    below_title = dropwhile(RULE.fullmatch, [line for line in lines if line][1:])
    said = takewhile(lambda line: not RULE.fullmatch(line) and line != TRIED, below_title)
    words = " ".join(" ".join(said).split()).rstrip(".")
    return words[:1].lower() + words[1:]
