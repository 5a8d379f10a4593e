"""Names of files as text that a terminal and a shell take literally.

Promise: whatever characters a name has, it can neither move the cursor, colour the terminal, begin
a new line, nor change the command it is printed in.
"""

from __future__ import annotations

import os
import shlex
import unicodedata
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

__all__ = ["did_you_mean", "quoted", "visible"]


def visible(text: object, keep: str = "") -> str:
    r"""Text with every control character written as an escape.

    Args:
        text: A name, or a sentence that holds some.
        keep: Characters that stay as they are, such as a newline.

    Example:
        >>> print(visible("a\x1b[31mb"), visible("写真 1"))
        a\x1b[31mb 写真 1
    """
    return "".join(each if each in keep or _shows(each) else _escape(each) for each in str(text))


def quoted(path: Path | str) -> str:
    r"""A path as one word of a command line, for a POSIX shell.

    Example:
        >>> print(quoted("my scene"), quoted("-o"), quoted("a\nb"))
        'my scene' ./-o $'a\nb'
    """
    text = str(path)
    text = f"./{text}" if text.startswith("-") else text
    if all(map(_shows, text)):
        return shlex.quote(text)
    return "$'" + "".join(map(_ansi_c, text)) + "'"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A question with the known word most similar to another, and a space; empty if none is.

    Dashes in front, which all options share, make no words similar.

    Example:
        >>> did_you_mean("--ratoi", ["--ratio", "--seed"])
        'Did you mean --ratio? '
    """
    bare = {each.lstrip("-"): each for each in known}
    close = get_close_matches(word.lower().lstrip("-"), list(bare), n=1, cutoff=0.6)
    return f"Did you mean {bare[close[0]]}? " if close else ""


def _shows(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def _ansi_c(character: str) -> str:
    r"""A character within $'...', which bash, zsh and POSIX of 2024 know."""
    if character in "\\'":
        return f"\\{character}"
    if _shows(character):
        return character
    if character in "\n\t\r":
        return _escape(character)
    return "".join(f"\\x{byte:02x}" for byte in os.fsencode(character))
