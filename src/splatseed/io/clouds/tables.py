"""Tables of numbers as text, read in blocks of lines: the bodies of XYZ, CSV, ascii PLY and PCD.

Notation: a table has named columns; *offset* is the byte at which its first line begins. Promise:
empty lines and lines that begin with # are skipped; memory holds one block of lines; a word that
is no number is reported with its line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CloudChunk
from splatseed.io.clouds.colors import SAMPLES
from splatseed.io.clouds.rows import COPY_AGAIN, XYZ, Columns, Painter, chunk_of
from splatseed.io.files import open_file

BLOCK = 1 << 24
"""Bytes read at once."""
SAMPLE_BYTES = 1 << 16


@dataclass(frozen=True)
class Dialect:
    """How numbers are written in a line.

    Args:
        delimiter: What stands between them; None for spaces and tabs.
        decimal_comma: Whether 1,5 is one and a half.
    """

    delimiter: str | None = None
    decimal_comma: bool = False

    def parse(self, lines: Sequence[str], places: Sequence[int]) -> Float64[np.ndarray, "N C"]:
        """Numbers at ``places`` of each line; raises ``ValueError`` where there is none."""
        if self.decimal_comma:
            lines = [line.replace(",", ".") for line in lines]
        return np.loadtxt(
            lines, np.float64, comments=None, delimiter=self.delimiter, usecols=places, ndmin=2
        )


class TextTable:
    """A table within a text file.

    Args:
        path: The file.
        names: The names of all columns, x, y and z among them.
        columns: Which of them are used for colours.
        offset: Where its first line begins, in bytes.
        skip: How many lines of numbers to leave out first.
        count: How many lines it must have; as many as there are when None.
        dialect: How numbers are written.

    Raises:
        SceneFormatError: A line of the sample holds no numbers.
    """

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        columns: Columns,
        offset: int = 0,
        skip: int = 0,
        count: int | None = None,
        dialect: Dialect | None = None,
    ) -> None:
        self.path, self.offset, self.skip, self.count = path, offset, skip, count
        self.dialect = dialect or Dialect()
        used = [*XYZ, *columns.rgb, *([columns.intensity] if columns.intensity else [])]
        self._places = [names.index(name) for name in used]
        self._used = used
        sample = self._table(self._sample() if columns.colors != "none" and not skip else [])
        self._painter = Painter(columns, self._column(sample))

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """The rows, at most ``size`` at a time.

        Raises:
            SceneFormatError: A word is no number, or lines are missing.
        """
        for chunk, _ in self.tables(size):
            yield chunk

    def tables(self, size: int) -> Iterator[tuple[CloudChunk, Callable[[str], np.ndarray]]]:
        """The same, and with each chunk its columns by name."""
        left, given = self.count, 0
        for lines in _gathered(self._lines(), size, self.skip, left):
            column = self._column(self._table(lines, given))
            given += len(lines)
            yield chunk_of(self._painter, column), column
        if left is not None and given < left:
            raise SceneFormatError(
                f"{left:,} points in {self.path}, as its header promises",
                found=f"{given:,}: the file is cut short",
                fix=COPY_AGAIN,
            )

    def _column(self, table: Float64[np.ndarray, "N C"]) -> Callable[[str], np.ndarray]:
        return lambda name: table[:, self._used.index(name)]

    def _table(self, lines: Sequence[str], given: int = 0) -> Float64[np.ndarray, "N C"]:
        if not lines:
            return np.empty((0, len(self._places)))
        try:
            return self.dialect.parse(lines, self._places)
        except ValueError:
            raise self._error(lines, given) from None

    def _error(self, lines: Sequence[str], given: int) -> SceneFormatError:
        """Which of some lines, after ``given`` others, is at fault."""
        for row, line in enumerate(lines, start=given + 1):
            try:
                self.dialect.parse([line], self._places)
            except ValueError:
                return SceneFormatError(
                    f"{max(self._places) + 1} numbers in row {row:,} of {self.path}",
                    found=repr(line[:80]),
                    fix="Remove the line, or export the cloud again.",
                )
        return SceneFormatError(f"numbers in {self.path}", found="others", fix=COPY_AGAIN)

    def _lines(self) -> Iterator[list[str]]:
        with open_file(self.path) as file:
            file.seek(self.offset)
            yield from _blocks(file)

    def _sample(self) -> list[str]:
        """Lines from places spread over the file."""
        first, last = self.offset, self.path.stat().st_size - SAMPLE_BYTES
        places = sorted(
            {max(first, first + (last - first) * i // (SAMPLES - 1)) for i in range(SAMPLES)}
        )
        lines: list[str] = []
        with open_file(self.path) as file:
            for place in places:
                file.seek(place)
                block = file.read(SAMPLE_BYTES).decode("latin-1").split("\n")
                lines += numbers(block[place > first : -1] or block[:1])
        return lines


def numbers(lines: Sequence[str]) -> list[str]:
    """The lines that are neither empty nor comments."""
    return [s for line in lines if (s := line.strip()) and s[0] != "#"]


def _blocks(file: BinaryIO) -> Iterator[list[str]]:
    """The lines of numbers from the file's position on, a block at a time."""
    rest = b""
    while data := file.read(BLOCK):
        whole, end, tail = (rest + data).rpartition(b"\n")
        rest = tail
        if end:
            yield numbers(whole.decode("latin-1").split("\n"))
    if rest:
        yield numbers([rest.decode("latin-1")])


def _gathered(
    blocks: Iterator[list[str]], size: int, skip: int, limit: int | None
) -> Iterator[list[str]]:
    """Lines in groups of ``size``, after ``skip`` and at most ``limit`` of them."""
    held: list[str] = []
    left = limit
    for block in blocks:
        held += block[skip:]
        skip = max(skip - len(block), 0)
        while len(held) >= size and left != 0:
            group = held[: size if left is None else min(size, left)]
            held = held[len(group) :]
            left = None if left is None else left - len(group)
            yield group
        if left == 0:
            return
    if group := held if left is None else held[:left]:
        yield group
