"""Names, numbers, bytes and errors as text that terminals, shells and people take as it is meant.

Promise: whatever characters a name has, it can neither move the cursor, colour the terminal, begin
a new line, nor change the command it is printed in.
"""

from __future__ import annotations

import re
import shlex
import unicodedata
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

MOST_TOLD = 160
OBJECT = re.compile(r"<[\w.]+[^<>]*(?: at 0x[0-9a-f]+|name=[^<>]*)>")
"""How Python shows an object that has no text of its own."""
SAID = {
    "builtins.IndexError": "fewer values than expected",
    "builtins.RecursionError": "values nested too deep",
    "builtins.TypeError": "a value of another kind",
    "builtins.UnicodeDecodeError": "bytes that are not UTF-8 text",
    "PIL.UnidentifiedImageError": "no picture of a known format",
    "struct.error": "fewer bytes than expected",
}
"""Exceptions whose own words are meant for programmers."""


def visible(text: object, keep: str = "") -> str:
    r"""Text with every control character but those to ``keep`` written as an escape.

    Example:
        >>> print(visible("a\x1b[31mb"), visible("写真 1"))
        a\x1b[31mb 写真 1
    """
    return "".join(each if each in keep or _shows(each) else _escape(each) for each in str(text))


def quoted(path: Path | str) -> str:
    r"""Quote a path as one word of a command line, for a POSIX shell.

    Example:
        >>> print(quoted("my scene"), quoted("-o"))
        'my scene' ./-o
    """
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def describe_error(error: Exception) -> str:
    """What the exception of a library says about a file, in words for its user.

    Example:
        >>> describe_error(KeyError("scale")), describe_error(ValueError("File is not a zip file"))
        ("no 'scale'", 'File is not a zip file')
    """
    kind = type(error).__name__
    said = SAID.get(f"{type(error).__module__}.{kind}")
    text = " ".join(OBJECT.sub("", str(error)).split())[:MOST_TOLD]
    if isinstance(error, KeyError):
        return f"no {text}"
    return said or (text if " " in text else f"{kind} {text}".strip())


def beginning(data: bytes, most: int = 16) -> str:
    r"""The first bytes of a file: as text if they are text, else as hexadecimal numbers.

    Example:
        >>> print(beginning(b"solid\n"), "and", beginning(bytes([137, 80, 0])))
        'solid' and the bytes 89 50 00
    """
    first = data[:most]
    if not first:
        return "an empty file"
    text = first.decode("ascii", "replace").strip()
    if text and text.isprintable() and "\ufffd" not in text:
        return repr(text)
    return f"the bytes {first.hex(' ')}"


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


def counted(number: int, noun: str) -> str:
    """A number and what it counts: "1 test view", "2,300 points"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def name_some(names: Sequence[str], most: int = 8) -> str:
    """The first few of some names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more:,} more" if more > 0 else "")


def agreeing(number: int, one: str, more: str) -> str:
    """The word that agrees with a number of things: ``one`` or ``more``."""
    return one if number == 1 else more


def _shows(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
