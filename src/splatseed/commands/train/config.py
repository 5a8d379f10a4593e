"""``splatseed train --config``: settings from a file, a .toml or the config.json of a run.

Promise: the command line takes precedence; a key that is not a setting is an error, not ignored,
except for what a run records about itself.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import read_text
from splatseed.literal import did_you_mean

Options = TypeVar("Options")

_NOTES = {"splatseed", "points", "device", "versions"}
"""What config.json records besides options."""
_RENAMED = {"seeding": "seeds"}
"""Settings whose options have other names."""
_FIX = "Write lines such as max_steps = 7000."


def with_config(options: Options, path: Path) -> Options:
    """Options with those that a file holds, as defaults for the command line.

    Args:
        options: A dataclass; those among its fields that are dataclasses hold options of their own.
        path: The file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read, or a key or a value is not an option's.
    """
    read = {key: value for key, value in _read(path).items() if not _is_note(key, value)}
    given = {_RENAMED.get(key, key): value for key, value in read.items()}
    filled = _filled(options, given, path)
    if unknown := next(iter(given), None):
        raise SceneFormatError(
            f"options of splatseed train in {path}",
            found=repr(unknown),
            fix=f"{did_you_mean(unknown, _names(options))}Run splatseed train --help to see them.",
        )
    return filled


def _is_note(key: str, value: object) -> bool:
    return key in _NOTES or value is None or (key == "seeds" and isinstance(value, dict))


def _filled(options: Options, given: dict[str, Any], path: Path) -> Options:
    """The options with the values given for them, which are taken out."""
    changes: dict[str, Any] = {}
    for name, hint in get_type_hints(type(options)).items():
        if dataclasses.is_dataclass(hint):
            changes[name] = _filled(getattr(options, name), given, path)
        elif name in given:
            changes[name] = _checked(name, given.pop(name), hint, path)
    return dataclasses.replace(options, **changes)  # type: ignore[type-var]  # it is a dataclass


def _names(options: Any) -> list[str]:
    inner = [getattr(options, each.name) for each in dataclasses.fields(options)]
    nested = [name for each in inner if dataclasses.is_dataclass(each) for name in _names(each)]
    return [*nested, *(each.name for each in dataclasses.fields(options))]


def _checked(name: str, value: object, hint: Any, path: Path) -> Any:
    """A value, if it is of the kind that an option's type hint names."""
    kinds = [hint] if get_origin(hint) is Literal else get_args(hint) or [hint]
    for kind in kinds:
        if get_origin(kind) is Literal and value in get_args(kind):
            return value
        if kind is Path and isinstance(value, str):
            return Path(value)
        if type(value) is kind:  # True is no number
            return value
    raise SceneFormatError(
        f"a value for {name} in {path} that the option takes", found=repr(value)[:80], fix=_FIX
    )


def _read(path: Path) -> Mapping[str, Any]:
    try:
        text = read_text(path)
        content = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise SceneNotFoundError(f"a file {path}", found="none", fix="Check the path.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise _unreadable(path, " ".join(str(error).split())) from None
    if not isinstance(content, dict):
        raise _unreadable(path, type(content).__name__)
    return content


def _unreadable(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to hold options of splatseed train, as TOML or a run's config.json",
        found=found[:160],
        fix=_FIX,
    )
