"""Parsing a verb's options: help, errors (exit code 2) and completion are tyro's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import tyro

from splatseed.errors import ParameterError

Options = TypeVar("Options")

CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
"""An option that can be left out takes no None, and a switch only changes its default."""


MaskChoice = Annotated[str | None, tyro.conf.arg(metavar="DIR|none|inverted[:DIR]")]
"""Which masks: see ``io.masks.with_masks``."""


def parse_options(
    kind: type[Options], verb: str, arguments: Sequence[str], default: Options | None = None
) -> Options:
    """The options in ``arguments``, the words after the verb; ``default`` gives the others."""
    given: dict[str, Any] = {} if default is None else {"default": default}
    prog = f"splatseed {verb}"
    options: Options = tyro.cli(kind, prog=prog, args=list(arguments), config=CONFIG, **given)
    return options


def refuse(*faults: tuple[object, str, object, str]) -> None:
    """Refuse the first (whether it is there, what was expected, found, and helps) that is there."""
    for there, expected, found, fix in faults:
        if there:
            raise ParameterError(expected, found=str(found), fix=fix)


def check_least(options: object, least: float, *names: str) -> None:
    """Refuse fields of parsed options below ``least``; None, for one not given, is none."""
    for name in names:
        value, option = getattr(options, name), f"--{name.replace('_', '-')}"
        wrong = value is not None and not value >= least
        refuse((wrong, f"{option} of {least:g} or more", value, "Leave it out for the default."))
