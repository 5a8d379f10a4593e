"""Parsing a verb's options: help, errors (exit code 2) and completion are tyro's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import tyro

from splatseed.errors import ParameterError

Options = TypeVar("Options")

CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
"""An option that can be left out takes no None, and a switch only changes its default."""


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
        SystemExit: With code 2 after telling what is wrong with an option; 0 after the help.
        ParameterError: A value is out of the range that a dataclass gives for it.
    """
    given: dict[str, Any] = {} if default is None else {"default": default}
    prog = f"splatseed {verb}"
    options: Options = tyro.cli(kind, prog=prog, args=list(arguments), config=CONFIG, **given)
    return options


def print_completion(verbs: Mapping[str, type[Any]], arguments: Sequence[str]) -> None:
    """Print a shell's script that completes verbs and options.

    Args:
        verbs: The options of each verb.
        arguments: ``--tyro-print-completion SHELL``, or to write it, what else tyro takes.
    """
    tyro.extras.subcommand_cli_from_dict(
        dict(verbs), prog="splatseed", args=list(arguments), config=CONFIG
    )


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
                f"--{name.replace('_', '-')} of {least:g} or more",
                found=f"{value}",
                fix="Leave it out for the default.",
            )
