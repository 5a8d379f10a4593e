"""Parse a verb's options with tyro, which prints help, errors (exit code 2) and completions.

What they name to write is checked and locked before any work is done. All verbs have the options of
``console.Reporting``, after their own.
"""

from __future__ import annotations

import dataclasses
import io
import logging
import shlex
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, redirect_stderr, suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from splatseed.console import Reporting, configure, hold, print_message
from splatseed.errors import OutputError, ParameterError
from splatseed.io.staging import check_parents, check_separate, reserved, translate_write_errors
from splatseed.requirements import version_of

Options = TypeVar("Options")

CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
"""Optional options take no None; a switch has no negated twin."""
_REPORTING = "reporting"
_WRITTEN = ("output", "renders", "gaussians", "picture")
"""Options that name what is written."""


def parse_options(
    kind: type[Options],
    verb: str,
    arguments: Sequence[str],
    default: Options | None = None,
    *,
    quiet: bool = False,
) -> Options:
    """Parse ``arguments``, which follow the verb; ``default`` holds the values of other options.

    From now on messages go where they ask for, and no other process may write what they name.

    Raises:
        OutputError: The output is - or another process writes it, or the log cannot be written.
        ParameterError: They exclude each other.
        SystemExit: They are wrong, which is printed unless ``quiet``, or ask for help.
    """
    full = with_reporting(kind)
    given: dict[str, Any] = {} if default is None else {"default": full(**_fields(default))}
    with _silence() if quiet else nullcontext():
        values = _fields(
            tyro.cli(
                full, prog=f"splatseed {verb}", args=list(arguments), config=CONFIG,
                console_outputs=not quiet, **given,
            )
        )  # fmt: skip
    reporting: Reporting = values.pop(_REPORTING)
    both = reporting.quiet and reporting.verbose
    refuse((both, "--quiet or --verbose", "both", "Leave one of them out."))
    with translate_write_errors(reporting.log or Path()):
        configure(reporting)
    command = shlex.join(["splatseed", *verb.split(), *arguments])
    print_message(f"splatseed {version_of('splatseed')}: {command}", logging.DEBUG)
    for path in {values[name] for name in _WRITTEN if values.get(name) is not None}:
        if str(path) == "-":
            fix = "Name one; --json prints the results to stdout."
            raise OutputError("the name of a file or folder to write", found="-", fix=fix)
        if not values.get("dry_run"):
            hold(reserved(path))
    return kind(**values)


def _silence() -> AbstractContextManager[object]:
    """Suppress what tyro prints of values that a class refuses, also without console_outputs."""
    return redirect_stderr(io.StringIO())


def with_reporting(kind: type[Any]) -> type[Any]:
    """Return a verb's options with those of ``Reporting``."""
    field = dataclasses.field(default=Reporting())
    own = (_REPORTING, Annotated[Reporting, tyro.conf.arg(name="")], field)
    full = dataclasses.make_dataclass(kind.__name__, [own], bases=(kind,), frozen=True)
    full.__doc__ = kind.__doc__
    return full


def _fields(options: Any) -> dict[str, Any]:
    return {each.name: getattr(options, each.name) for each in dataclasses.fields(options)}


def parse_some(kind: type[Options], arguments: Sequence[str]) -> Options:
    """Parse the options of ``kind`` and skip all others.

    For options that determine which others there are or their defaults, such as ``--profile``. If
    one is invalid, all have their defaults: ``parse_options`` then reports the error.
    """
    with suppress(SystemExit), _silence():
        return tyro.cli(
            kind, args=list(arguments), config=CONFIG, add_help=False, console_outputs=False,
            return_unknown_args=True,
        )[0]  # fmt: skip
    return kind()


def refuse(*faults: tuple[object, str, object, str]) -> None:
    """Raise for the first (condition, expected, found, fix) whose condition holds."""
    for condition, expected, found, fix in faults:
        if condition:
            raise ParameterError(expected, found=str(found), fix=fix)


def check_minimum(options: object, minimum: float, *names: str) -> None:
    """Refuse fields of parsed options below ``minimum``; options left unset are skipped."""
    for name in names:
        value, option = getattr(options, name), f"--{name.replace('_', '-')}"
        wrong = value is not None and not value >= minimum
        expected = f"{option} of {minimum:g} or more"
        refuse((wrong, expected, value, "Leave it out for the default."))


def check_free(
    path: Path,
    *,
    overwrite: bool = False,
    protect: Sequence[Path] = (),
    fix: str = "Pass --overwrite to replace it, or choose another name.",
) -> None:
    """Refuse an output file that may not be written, before any work is done.

    It must neither equal nor lie in the inputs ``protect``; ``fix`` is for a file that exists.
    """
    check_separate(path, protect)
    check_parents(path)
    if path.exists() and not path.is_file():
        found = "a folder" if path.is_dir() else "no regular file"
        raise OutputError(f"a file name at {path}", found=found, fix="Choose another name.")
    if path.exists() and not overwrite:
        raise OutputError(f"no file at {path}", found="one", fix=fix)
