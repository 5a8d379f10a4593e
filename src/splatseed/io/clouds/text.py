"""Text clouds (XYZ, CSV, TXT, ASC, PTS): one point per line, with any delimiter.

Delimiter, decimal comma and header line are detected from the first lines. Without a header, rows
from the whole file decide what columns are (``columns``), unless the caller names them;
``findings`` report the guess. PTS files have intensity before colours, and before each of their
scans a line with the number of its points.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.findings import Finding
from splatseed.io.cloud_file import (
    RGB,
    SAMPLE_BYTES,
    XYZ,
    CloudFile,
    Dialect,
    LineCloud,
    sample_lines,
)
from splatseed.io.clouds.columns import possible_columns
from splatseed.io.files import open_file

_NAMES = (
    {"easting": "x", "northing": "y", "elevation": "z", "height": "z", "altitude": "z"}
    | {"r": "red", "g": "green", "b": "blue", "rf": "red", "gf": "green", "bf": "blue"}
    | {"i": "intensity"}
)
"""Other names of columns, in lower case."""
_COMMENT = re.compile(r"^(//|#|%|;)+\s*")
_BRACKETS = re.compile(r"[\[(].*?[\])]")
_MARK = "\ufeff".encode().decode("latin-1")
"""The byte order mark of UTF-8, which Windows programs write."""
_SKIPPED, _NEAR = "_", 5
"""Name of a column that is not read; lines before the first row, one of which may name columns."""
_COLUMNS = (*XYZ, "red", "green", "blue", "intensity", "nx", "ny", "nz")


def open_text(path: Path, columns: str | Sequence[str] = ()) -> CloudFile:
    """Open a text file of points; ``columns`` as of ``open_cloud``."""
    with open_file(path) as file:
        head = file.read(SAMPLE_BYTES).decode("latin-1")
    lines = head.split("\n")[: None if len(head) < SAMPLE_BYTES else -1]
    marked = lines[0].startswith(_MARK)
    lines[0] = lines[0].removeprefix(_MARK)
    given = _given(columns)
    first, dialect = _first_line(path, lines, given)
    # Of latin-1, a byte is a character.
    offset = marked * len(_MARK) + sum(len(line) + 1 for line in lines[:first])
    is_pts = path.suffix.lower() == ".pts"
    num = len(_fields(lines[first], dialect))
    if given and len(given) != num:
        raise ParameterError(
            f"`cloud.columns` to name the {num} columns of {path}",
            found=f"{len(given)}",
            fix=f"Name all columns; {_SKIPPED} skips one.",
        )
    named = given or _named(lines[max(first - _NEAR, 0) : first], dialect, num)
    names = named or _guessed(path, offset, dialect, num, is_pts=is_pts)
    cloud = LineCloud(path, names, offset, dialect=dialect, counts=is_pts)
    if named is None:
        place, colors = names.index("x") + 1, "none as colours"
        if cloud.colors == "rgb":
            column = names.index(RGB[0]) + 1
            colors = f"{column} to {column + 2} as red, green, blue"
        elif cloud.colors == "intensity":
            colors = f"{names.index('intensity') + 1} as intensity"
        guess = f"columns {place} to {place + 2} of {path.name} are taken as x, y, z, {colors}"
        text = f"No header line names columns: {guess}."
        cloud.findings = (Finding("guessed-columns", text, fix=_fix(names)),)
    return cloud


def _given(columns: str | Sequence[str]) -> list[str] | None:
    """Return the full names of columns that the caller named; None without."""
    text = columns if isinstance(columns, str) else " ".join(columns)
    words = [word for word in re.split(r"[\s,]+", text.lower()) if word]
    if not words:
        return None
    known = [f"column {i + 1}" if w == _SKIPPED else _NAMES.get(w, w) for i, w in enumerate(words)]
    chosen = [name for name, word in zip(known, words, strict=True) if word != _SKIPPED]
    colors = sum(name in RGB for name in chosen)
    if not set(XYZ) <= set(chosen) <= set(_COLUMNS) or len({*chosen}) < len(chosen) or colors % 3:
        raise ParameterError(
            "`cloud.columns` with each of x, y, z, and r, g, b, i, nx, ny, nz where there are, or "
            f"{_SKIPPED} to skip a column",
            found=" ".join(words),
            fix="Name the columns in their order, such as `cloud.columns='x y z i r g b'`.",
        )
    return known


def _guessed(path: Path, offset: int, dialect: Dialect, count: int, *, is_pts: bool) -> list[str]:
    """Name columns by rows from the whole file; the reader reports those of another length."""
    rows = sample_lines(path, offset, counts=is_pts)
    complete = [row for row in rows if len(_fields(row, dialect)) == count]
    try:
        first, *others = possible_columns(dialect.parse(complete, range(count)), is_pts=is_pts)
    except ValueError as error:
        raise SceneFormatError(
            f"numbers in every row of {path}", found=str(error)[:120], fix="Export it again."
        ) from None
    if others:
        others = others[-1:]
        places = [names.index(RGB[0]) + 1 for names in (first, *others)]
        raise SceneFormatError(
            f"{path} to show which of its {count} columns are red, green, blue",
            found=" or ".join(f"{at} to {at + 2}" for at in places) + ", which look alike",
            fix=f"{_fix(first, 'Pass')[:-1]} or {_columns(*others)}, whichever is right.",
        )
    return first


def _fix(names: Sequence[str], start: str = "If they are others, pass") -> str:
    return f"{start} {_columns(names)}."


def _columns(names: Sequence[str]) -> str:
    """Return the argument that names columns."""
    short = {"red": "r", "green": "g", "blue": "b", "intensity": "i"}
    words = [_SKIPPED if name.startswith("column") else short.get(name, name) for name in names]
    return f"`cloud.columns={' '.join(words)!r}`"


def _first_line(
    path: Path, lines: Sequence[str], given: Sequence[str] | None
) -> tuple[int, Dialect]:
    """Find the first line of three or more numbers, and its dialect.

    Where columns are named, other fields than x, y, z may be text, such as a point's name.
    """
    for i, line in enumerate(lines):
        for dialect in _dialects(line):
            fields = _fields(line, dialect)
            names = given or _named(lines[max(i - _NEAR, 0) : i], dialect, len(fields))
            if names and len(names) == len(fields):
                fields = [fields[names.index(axis)] for axis in XYZ]
            with suppress(ValueError):
                if len([float(field) for field in fields]) >= 3:
                    return i, dialect
    found = next((repr(line.strip()[:60]) for line in lines if line.strip()), "an empty file")
    if any("\0" in line for line in lines):
        found = "text in UTF-16, or no text: save it as UTF-8"
    raise SceneFormatError(
        f"{path} to have one point per line, x y z first or below a header line",
        found=found,
        fix="Name its columns, such as `cloud.columns='_ x y z r g b'` where the first is text, or "
        "export the cloud in another format.",
    )


def _dialects(line: str) -> Iterator[Dialect]:
    if ";" in line:
        yield Dialect(";", decimal_comma="," in line)
    if "," in line:
        yield Dialect(",")
    yield Dialect(None)
    if "," in line:
        yield Dialect(None, decimal_comma=True)


def _fields(line: str, dialect: Dialect) -> list[str]:
    text = line.strip().replace(",", ".") if dialect.decimal_comma else line.strip()
    if dialect.delimiter:
        text = text.removesuffix(dialect.delimiter)  # some writers end lines with one
    return [field.strip().strip('"') for field in text.split(dialect.delimiter)]


def _named(lines: Sequence[str], dialect: Dialect, count: int) -> list[str] | None:
    """Read column names from the last line before the numbers with as many fields."""
    for line in reversed(lines):
        header = _BRACKETS.sub("", _COMMENT.sub("", line.strip()))
        for delimiter in (dialect.delimiter, None, ",", ";", "\t"):
            fields = [field.strip().strip('"').lower() for field in header.split(delimiter)]
            names = [_NAMES.get(field, field) for field in fields]
            names = names[:-1] if len(names) == count + 1 and not names[-1] else names
            if len(names) == count and set(XYZ) <= set(names):
                return names
    return None
