"""``splatseed train --config``: options from a file, a .toml or the config.json of a run.

Promise: the command line takes precedence; a key that is not an option is an error, not ignored,
except for what a run records about itself.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import read_text
from splatseed.literal import did_you_mean

NOTES = {"splatseed", "points", "device", "versions"}
"""What config.json records besides settings."""
RENAMED = {"seeding": "seeds"}
"""Settings whose options have other names."""


def with_config(words: Sequence[str], known: Sequence[str]) -> list[str]:
    """A command line with ``--config FILE`` replaced by the options that the file holds.

    Args:
        words: The words after the verb.
        known: All options, such as ``--max-steps``; both forms of a switch.

    Raises:
        ParameterError: ``--config`` has no file.
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read, or a key or a value is not an option's.
    """
    rest, path = _without_config(list(words))
    if path is None:
        return rest
    given = {word.partition("=")[0] for word in rest if word.startswith("-")}
    added: list[str] = []
    for key, value in _read(path).items():
        name = RENAMED.get(key, key).replace("_", "-")
        if key in NOTES or value is None or (name == "seeds" and isinstance(value, dict)):
            continue
        if name == "scene":
            added = [*([] if _has_scene(rest, known) else [str(value)]), *added]
        elif f"--{name}" not in known:
            raise _unknown(path, key, known)
        elif not {f"--{name}", f"--no-{name}", *(["-o"] if name == "output" else [])} & given:
            added += _words(path, name, value)
    return [*added, *rest]


def _without_config(words: list[str]) -> tuple[list[str], Path | None]:
    for i, word in enumerate(words):
        if word.startswith("--config="):
            return words[:i] + words[i + 1 :], Path(word.partition("=")[2])
        if word == "--config":
            if i + 1 == len(words):
                raise ParameterError("a file after --config", found="none", fix="Name a .toml.")
            return words[:i] + words[i + 2 :], Path(words[i + 1])
    return words, None


def _read(path: Path) -> dict[str, Any]:
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
        fix="Write lines such as max_steps = 7000.",
    )


def _unknown(path: Path, key: str, known: Sequence[str]) -> SceneFormatError:
    options = {each.removeprefix("--").replace("-", "_") for each in known if len(each) > 2}
    return SceneFormatError(
        f"options of splatseed train in {path}",
        found=repr(key),
        fix=f"{did_you_mean(key, options)}Run splatseed train --help to see them.",
    )


def _words(path: Path, name: str, value: Any) -> list[str]:
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    if isinstance(value, str | int | float):
        return [f"--{name}", str(value)]
    raise SceneFormatError(
        f"{name.replace('-', '_')} in {path} to be a number, a text or true or false",
        found=type(value).__name__,
        fix="Write lines such as max_steps = 7000.",
    )


def _has_scene(words: Sequence[str], known: Sequence[str]) -> bool:
    """Whether some word is neither an option nor an option's value."""
    value_follows = False
    for word in words:
        if value_follows:
            value_follows = False
        elif not word.startswith("-"):
            return True
        else:
            switch = f"--no-{word.removeprefix('--')}" in known or word.startswith("--no-")
            value_follows = "=" not in word and not switch
    return False
