"""Text clouds (XYZ, CSV, TXT, ASC, PTS): one point per line, with any delimiter.

Delimiter, decimal comma and header line are detected from the first lines. Without a header,
columns 1 to 3 are the position. The colour is the first run of three columns with integers from 0
to 65535, or with numbers from 0 to 1 that are not unit normals; if the first of them exceeds 255
and three bytes follow it, it is intensity. A fourth and last column is intensity. ``findings``
report the guess. PTS files start with the point count and have intensity before colours.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.cloud_file import RGB, SAMPLE_BYTES, XYZ, CloudFile, Dialect, LineCloud
from splatseed.io.files import open_file

_NAMES = (
    {"easting": "x", "northing": "y", "elevation": "z", "height": "z", "altitude": "z"}
    | {"r": "red", "g": "green", "b": "blue", "rf": "red", "gf": "green", "bf": "blue"}
    | {"i": "intensity"}
)
"""Other names of columns, in lower case."""
_COMMENT = re.compile(r"^(//|#|%|;)+\s*")
_UNIT = 1e-2
"""Largest difference from 1 in the length of a normal."""
_BYTE = 255


def open_text(path: Path) -> CloudFile:
    """Open a text file of points."""
    with open_file(path) as file:
        head = file.read(SAMPLE_BYTES).decode("latin-1")
    lines = head.split("\n")[: None if len(head) < SAMPLE_BYTES else -1]
    first, dialect = _first_line(path, lines)
    rows = [line.strip() for line in lines[first:] if line.strip()]
    num = len(_fields(rows[0], dialect))
    try:  # the reader reports rows of another length than the first
        complete = [row for row in rows if len(_fields(row, dialect)) == num]
        sample = dialect.parse(complete, range(num))
    except ValueError as error:
        raise SceneFormatError(
            f"numbers in every row of {path}", found=str(error)[:120], fix="Export it again."
        ) from None
    named = _named(lines[:first], dialect, num)
    names = named or _guessed(sample, path.suffix.lower() == ".pts")
    offset = sum(len(line) + 1 for line in lines[:first])  # latin-1: a byte per character
    cloud = LineCloud(path, names, offset, dialect=dialect)
    if named is None:
        colors = "none as colours"
        if cloud.colors == "rgb":
            column = names.index(RGB[0]) + 1
            colors = f"{column} to {column + 2} as red, green, blue"
        elif cloud.colors == "intensity":
            colors = "4 as intensity"
        guess = f"columns 1 to 3 of {path.name} are taken as x, y, z, {colors}"
        text = f"It has no header line: {guess}."
        cloud.findings = (Finding("guessed-columns", text),)
    return cloud


def _first_line(path: Path, lines: Sequence[str]) -> tuple[int, Dialect]:
    """Find the first line of three or more numbers, and its dialect."""
    for i, line in enumerate(lines):
        for dialect in _dialects(line):
            with suppress(ValueError):
                if len([float(field) for field in _fields(line, dialect)]) >= 3:
                    return i, dialect
    found = next((repr(line.strip()[:60]) for line in lines if line.strip()), "an empty file")
    raise SceneFormatError(
        f"{path} to have one point per line, x y z first or below a header line",
        found=found,
        fix="Export the cloud as text with x, y, z, or in another format.",
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
    return [field.strip().strip('"') for field in text.split(dialect.delimiter)]


def _named(lines: Sequence[str], dialect: Dialect, count: int) -> list[str] | None:
    """Read column names from the last line before the numbers with as many fields."""
    for line in reversed(lines):
        header = _COMMENT.sub("", line.strip())
        for delimiter in (dialect.delimiter, None, ",", ";", "\t"):
            fields = [field.strip().strip('"').lower() for field in header.split(delimiter)]
            names = [_NAMES.get(field, field) for field in fields]
            if len(names) == count and set(XYZ) <= set(names):
                return names
    return None


def _guessed(sample: Float64[np.ndarray, "N C"], is_pts: bool) -> list[str]:
    count = sample.shape[1]
    names = [*XYZ, *(f"column {i + 1}" for i in range(3, count))]
    start = 4 if is_pts and count == 7 else _first_colors(sample)
    if start is not None and _are_colors(sample[:, start : start + 3]):
        names[start : start + 3] = RGB
    elif count == 4:
        names[3] = "intensity"
    return names


def _first_colors(sample: Float64[np.ndarray, "N C"]) -> int | None:
    """Return the first of three columns that look like colours; None without any."""
    start, last = len(XYZ), sample.shape[1] - len(RGB)
    while start <= last:
        columns = sample[:, start : start + 3]
        if _are_normals(columns):
            start += 3
        elif not _are_colors(columns):
            start += 1
        else:
            # An intensity of more than 8 bits before bytes: together they would be nearly black.
            bytes_follow = start < last and _are_colors(sample[:, start + 1 : start + 4])
            bytes_follow = bytes_follow and sample[:, start + 1 : start + 4].max() <= _BYTE
            return start + 1 if bytes_follow and columns[:, 0].max() > _BYTE else start
    return None


def _are_colors(values: Float64[np.ndarray, "N 3"]) -> bool:
    known = values[np.isfinite(values).all(axis=1)]
    if not len(known) or known.min() < 0:
        return False
    in_unit = known.max() <= 1.0 and not _are_normals(values)
    return bool(in_unit or (known.max() <= 65535 and (known == np.rint(known)).all()))


def _are_normals(values: Float64[np.ndarray, "N 3"]) -> bool:
    """Whether most rows are of length 1, and not all of them whole numbers."""
    known = values[np.isfinite(values).all(axis=1)]
    is_unit = np.abs(np.linalg.norm(known, axis=1) - 1.0) <= _UNIT
    return bool((known != np.rint(known)).any() and is_unit.mean() >= 0.5)
