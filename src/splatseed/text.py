"""Format names, numbers, bytes and errors for terminals, shells and users.

A name, whatever its characters, can neither move the cursor, colour the terminal or start a line
(``visible``), nor change the command it is printed in (``quoted``).
"""

from __future__ import annotations

import re
import shlex
import traceback
import unicodedata
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

MAX_ERROR_LENGTH = 160
"""Characters of an error of another library that messages repeat."""
OBJECT = re.compile(r"<[\w.]+[^<>]*(?: at 0x[0-9a-f]+|name=[^<>]*)>")
"""The default ``repr`` of a Python object."""
ERROR_TEXTS = {
    "builtins.IndexError": "fewer values than expected",
    "builtins.RecursionError": "values nested too deep",
    "builtins.TypeError": "a value of another kind",
    "builtins.UnicodeDecodeError": "bytes that are not UTF-8 text",
    "PIL.UnidentifiedImageError": "no picture of a known format",
    "struct.error": "fewer bytes than expected",
}
"""Texts for exceptions whose own texts are meant for programmers."""


def visible(text: object, keep: str = "") -> str:
    r"""Escape the control characters of a text, but those in ``keep``.

    Example:
        >>> print(visible("a\x1b[31mb"), visible("写真 1"))
        a\x1b[31mb 写真 1
    """
    return "".join(c if c in keep or _is_visible(c) else _escape(c) for c in str(text))


def quoted(path: Path | str) -> str:
    r"""Quote a path as one word of a command line, for a POSIX shell.

    Example:
        >>> print(quoted("my scene"), quoted("-o"))
        'my scene' ./-o
    """
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def numeric_order(name: str) -> list[str | int]:
    """Return a sort key that orders the numbers in names by value.

    Example:
        >>> sorted(["10.jpg", "9.jpg", "010b.jpg"], key=numeric_order)
        ['9.jpg', '10.jpg', '010b.jpg']
    """
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", name))]


def describe_exception(error: Exception) -> str:
    """Describe an exception of another's code for its author, with the line that raised it."""
    *_, last = traceback.extract_tb(error.__traceback__)
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return f"{text} ({last.filename}, line {last.lineno})"


def describe_error(error: Exception) -> str:
    """Describe another library's exception about a file, for the user.

    Example:
        >>> describe_error(KeyError("scale")), describe_error(ValueError("File is not a zip file"))
        ("no 'scale'", 'File is not a zip file')
    """
    kind = type(error).__name__
    known = ERROR_TEXTS.get(f"{type(error).__module__}.{kind}")
    text = " ".join(OBJECT.sub("", str(error)).split())[:MAX_ERROR_LENGTH]
    if isinstance(error, KeyError):
        return f"no {text}"
    return known or (text if " " in text else f"{kind} {text}".strip())


def beginning(data: bytes, limit: int = 16) -> str:
    r"""Show the first bytes of a file, as text if they are ASCII, else as hexadecimal numbers.

    Example:
        >>> print(beginning(b"solid\n"), "and", beginning(bytes([137, 80, 0])))
        'solid' and the bytes 89 50 00
    """
    first = data[:limit]
    if not first:
        return "an empty file"
    text = first.decode("ascii", "replace").strip()
    if text and text.isprintable() and "\ufffd" not in text:
        return repr(text)
    return f"the bytes {first.hex(' ')}"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Ask for the most similar known word, with a space at the end; empty if none is similar.

    Leading dashes do not count.

    Example:
        >>> did_you_mean("--ratoi", ["--ratio", "--seed"])
        'Did you mean --ratio? '
    """
    by_name = {word.lstrip("-"): word for word in known}
    close = get_close_matches(word.lower().lstrip("-"), list(by_name), n=1, cutoff=0.6)
    return f"Did you mean {by_name[close[0]]}? " if close else ""


def counted(number: int, noun: str) -> str:
    """Format a number of things: "1 test view", "2,300 points"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def name_some(names: Sequence[str], limit: int = 8) -> str:
    """List the first names, and the number of the others."""
    more = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {more:,} more" if more > 0 else "")


def agreeing(number: int, singular: str, plural: str) -> str:
    """Choose the form of a word that agrees with a number."""
    return singular if number == 1 else plural


def format_duration(seconds: float) -> str:
    """Format an estimated duration.

    Example:
        >>> format_duration(40), format_duration(3000), format_duration(200_000)
        ('40 s', '50 minutes', '56 hours')
    """
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if seconds < 5400:
        return f"{round(seconds / 60)} minutes"
    return f"{int(seconds / 3600 + 0.5)} hours"


def _is_visible(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
