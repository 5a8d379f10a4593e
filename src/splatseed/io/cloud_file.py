"""Clouds from elsewhere: what every reader offers, and what readers share.

Notation: a *row* is one point of a file; a *column* is a function from a column's name to its
values in some rows; *full* is the value that means 255: 1, 255 or 65535. Formats with 16-bit
colours are filled with 8-bit values by many writers, so the values decide, not the type.
Promise: a file is never held in memory whole where its format permits reading in parts; ranges of
colours are found in a sample before the first chunk, so that chunks of any size give the same
points; colours beyond the range are clipped, and what is not a number becomes mid grey.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Shaped, UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.files import COPY_AGAIN, open_file

CHUNK = 1 << 20
"""Rows read at once unless the caller says otherwise: 50 to 100 MB while they are read."""
Colors: TypeAlias = Literal["rgb", "intensity", "none"]
"""Where the colours of a file's chunks come from."""
Column: TypeAlias = Callable[[str], Any]
XYZ = ("x", "y", "z")
RGB_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
SAMPLES, SAMPLE_ROWS, SAMPLE_BYTES = 16, 4096, 1 << 16
"""Places in a file that are looked at to find ranges, and rows, or bytes of text, at each."""

_SH_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
_SH0 = 0.28209479177387814  # 1 / (2 sqrt(pi)); colour = 0.5 + SH0 * f_dc in 3DGS
_INTENSITY_NAMES = (
    *("intensity", "scalar_intensity", "scalar_Intensity", "Intensity"),
    *("reflectance", "scalar_Reflectance"),
)
_GREY = 128
_DARK, _BRIGHT = 1.0, 99.0
"""Percentiles of intensity that become black and white: single mirrors outshine a whole scan."""
_BLOCK = 1 << 22
"""Bytes of text read at once."""


@dataclass(frozen=True, eq=False)
class CloudChunk:
    """Consecutive rows of a file.

    Args:
        xyz: Positions in the file's coordinates, float64 [n, 3]; may hold NaN or infinity.
        rgb: Colours, uint8 [n, 3], grey where the file has intensity only; None without either.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def finite(self) -> Bool[np.ndarray, " n"]:
        """Which rows have three finite coordinates."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    def select(self, which: np.ndarray | slice) -> CloudChunk:
        """The rows at ``which`` (a mask, indices or a slice)."""
        return CloudChunk(self.xyz[which], None if self.rgb is None else self.rgb[which])


class CloudFile(ABC):
    """A file of points, opened but not read.

    Attributes:
        path: The file.
        count: Rows that its header promises; None where only reading tells. ``chunks`` may give
            fewer, as rows that the file itself marks as invalid are left out.
        bounds: Least and greatest coordinates, float64 [2, 3], where the header states them; they
            are what the file claims, and are not checked.
        colors: Where the colours come from.
        warnings: What is odd about the file, one sentence each.
    """

    path: Path
    count: int | None = None
    bounds: Float64[np.ndarray, "2 3"] | None = None
    colors: Colors = "none"
    warnings: tuple[str, ...] = ()

    @property
    def has_color(self) -> bool:
        """Whether its points have colours, rather than intensity or nothing."""
        return self.colors == "rgb"

    @abstractmethod
    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """The rows in file order, at most ``size`` at a time; no chunk is empty.

        Raises:
            SceneFormatError: The file ends early, or a row makes no sense.
        """


def check_size(path: Path, needed: int) -> None:
    """Check that a file has at least ``needed`` bytes.

    Raises:
        SceneFormatError: It is shorter.
    """
    size = path.stat().st_size
    if size < needed:
        raise SceneFormatError(
            f"{path} to have {needed:,} bytes, as its header promises",
            found=f"{size:,}: the file is cut short",
            fix=COPY_AGAIN,
        )


@dataclass(frozen=True)
class Columns:
    """Which columns of a table hold colours.

    Args:
        rgb: Names of the three colour columns; empty for none.
        intensity: Name of the intensity column; None for none, or where there are colours.
    """

    rgb: tuple[str, ...] = ()
    intensity: str | None = None

    @classmethod
    def among(cls, names: Sequence[str]) -> Columns:
        """The columns that a table with these names has."""
        rgb = next((each for each in (*RGB_NAMES, _SH_NAMES) if set(each) <= set(names)), ())
        intensity = next((each for each in _INTENSITY_NAMES if each in names), None)
        return cls(rgb, None if rgb else intensity)

    @property
    def colors(self) -> Colors:
        """Where colours come from."""
        return "rgb" if self.rgb else "intensity" if self.intensity else "none"


class Painter:
    """Turns columns into colours, with ranges found in a sample.

    Args:
        columns: Which columns to use.
        sample: Gives some rows; called if there are colours.
    """

    def __init__(self, columns: Columns, sample: Callable[[], Column]) -> None:
        self._columns = columns
        column = sample() if columns.colors != "none" else None
        if columns.rgb and column:
            self._full = full_value(np.stack([column(name) for name in columns.rgb], axis=1))
        elif columns.intensity and column:
            known = np.asarray(column(columns.intensity), np.float64)
            known = known[np.isfinite(known)]
            low, high = np.percentile(known, (_DARK, _BRIGHT)) if known.size else (0.0, 1.0)
            self._low, self._high = float(low), float(max(high, low))
            self._high += self._high == self._low

    def paint(self, column: Column) -> UInt8[np.ndarray, "n 3"] | None:
        """The colours of some rows; None without any."""
        if self._columns.rgb == _SH_NAMES:
            sh0 = np.stack([column(name) for name in _SH_NAMES], axis=1).astype(np.float64)
            return color_bytes(0.5 + _SH0 * sh0, 1.0)
        if self._columns.rgb:
            values = np.stack([column(name) for name in self._columns.rgb], axis=1)
            return color_bytes(values, self._full)
        if self._columns.intensity:
            values = np.asarray(column(self._columns.intensity), np.float64)
            grey = color_bytes((values - self._low) / (self._high - self._low), 1.0)
            return np.repeat(grey[:, None], 3, axis=1)
        return None

    def chunk(self, column: Column) -> CloudChunk:
        """Some rows with their colours."""
        return CloudChunk(positions(column), self.paint(column))


def full_value(sample: Shaped[np.ndarray, "..."]) -> float:
    """The value that means 255, as a sample of colours suggests."""
    if sample.dtype == np.uint8 or not sample.size:
        return 255.0
    greatest = float(np.nanmax(np.asarray(sample, np.float64), initial=0.0))
    if greatest > 255.0:
        return 65535.0
    return 1.0 if sample.dtype.kind == "f" and greatest <= 1.0 else 255.0


def color_bytes(values: Shaped[np.ndarray, "..."], full: float) -> UInt8[np.ndarray, "..."]:
    """Colours of any numeric type as bytes, rounded."""
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    known = np.nan_to_num(np.asarray(values, np.float64) * (255.0 / full), nan=_GREY)
    return np.asarray(np.clip(np.rint(known), 0, 255).astype(np.uint8))


def positions(column: Column, names: Sequence[str] = XYZ) -> Float64[np.ndarray, "n 3"]:
    """The positions of some rows; damaged ones may not be finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.stack([np.asarray(column(name), np.float64) for name in names], axis=1)


def sample_starts(count: int) -> list[int]:
    """First rows of the places that are looked at, spread over a file of ``count`` rows."""
    last = max(count - SAMPLE_ROWS, 0)
    return sorted({last * i // (SAMPLES - 1) for i in range(SAMPLES)}) if count else []


@dataclass(frozen=True)
class RowTable:
    """Binary rows of one length within a file, read by offset.

    Args:
        path: The file.
        dtype: The layout of a row.
        offset: Where the first begins, in bytes.
        count: How many there are.

    Raises:
        SceneFormatError: The file is shorter than that.
    """

    path: Path
    dtype: np.dtype[Any]
    offset: int
    count: int

    def __post_init__(self) -> None:
        check_size(self.path, self.offset + self.count * self.dtype.itemsize)

    def columns(self, size: int) -> Iterator[Column]:
        """The rows, at most ``size`` at a time."""
        for start in range(0, self.count, size):
            yield self._rows(start, size).__getitem__

    def sample(self) -> Column:
        """Rows from places spread over the file."""
        parts = [self._rows(start, SAMPLE_ROWS) for start in sample_starts(self.count)]
        return np.concatenate([np.empty(0, self.dtype), *parts]).__getitem__

    def _rows(self, start: int, size: int) -> np.ndarray:
        wanted = min(size, self.count - start)
        with open_file(self.path) as file:
            file.seek(self.offset + start * self.dtype.itemsize)
            return np.frombuffer(file.read(wanted * self.dtype.itemsize), self.dtype, wanted)


@dataclass(frozen=True)
class Dialect:
    """How numbers are written in a line.

    Args:
        delimiter: What stands between them; None for spaces and tabs.
        decimal_comma: Whether 1,5 is one and a half.
    """

    delimiter: str | None = None
    decimal_comma: bool = False

    def parse(self, lines: Sequence[str], places: Sequence[int]) -> Float64[np.ndarray, "n C"]:
        """Numbers at ``places`` of each line; raises ``ValueError`` where there is none."""
        if self.decimal_comma:
            lines = [line.replace(",", ".") for line in lines]
        return np.loadtxt(
            lines, np.float64, comments=None, delimiter=self.delimiter, usecols=places, ndmin=2
        )


@dataclass(frozen=True)
class TextTable:
    """Lines of numbers within a file: XYZ, CSV, ascii PLY and PCD, read in blocks of lines.

    Empty lines and lines that begin with # are skipped.

    Args:
        path: The file.
        names: The names of all columns.
        used: Those that are read.
        offset: Where the first line begins, in bytes.
        count: How many lines it must have; as many as there are when None.
        dialect: How numbers are written.
        integers: Columns that hold integers.
    """

    path: Path
    names: Sequence[str]
    used: Sequence[str]
    offset: int = 0
    count: int | None = None
    dialect: Dialect = Dialect()
    integers: frozenset[str] = frozenset()

    def columns(self, size: int) -> Iterator[Column]:
        """The rows, at most ``size`` at a time.

        Raises:
            SceneFormatError: A word is no number, or lines are missing.
        """
        given, held = 0, list[str]()
        limit = self.count
        for block in self._blocks():
            held += block
            while len(held) >= size and given != limit:
                lines = held[: size if limit is None else min(size, limit - given)]
                held = held[len(lines) :]
                yield self._column(lines, given)
                given += len(lines)
            if given == limit:
                return
        lines = held if limit is None else held[: limit - given]
        if limit is not None and given + len(lines) < limit:
            raise SceneFormatError(
                f"{limit:,} points in {self.path}, as its header promises",
                found=f"{given + len(lines):,}: the file is cut short",
                fix=COPY_AGAIN,
            )
        if lines:
            yield self._column(lines, given)

    def sample(self) -> Column:
        """Rows from places spread over the file."""
        first, last = self.offset, self.path.stat().st_size - SAMPLE_BYTES
        places = {max(first, first + (last - first) * i // (SAMPLES - 1)) for i in range(SAMPLES)}
        lines: list[str] = []
        with open_file(self.path) as file:
            for place in sorted(places):
                file.seek(place)
                block = file.read(SAMPLE_BYTES).decode("latin-1").split("\n")
                lines += _numbers(block[place > first : -1] or block[:1])
        return self._column(lines[: self.count], 0)

    def _column(self, lines: Sequence[str], given: int) -> Column:
        places = [self.names.index(name) for name in self.used]
        table = np.empty((0, len(places)))
        try:
            table = self.dialect.parse(lines, places) if lines else table
        except ValueError:
            raise self._error(lines, places, given) from None

        def column(name: str) -> np.ndarray:
            values = table[:, self.used.index(name)]
            with np.errstate(invalid="ignore"):
                return values.astype(np.int64) if name in self.integers else values

        return column

    def _error(self, lines: Sequence[str], places: list[int], given: int) -> SceneFormatError:
        """Which of some lines, after ``given`` others, is at fault."""
        for row, line in enumerate(lines, start=given + 1):
            try:
                self.dialect.parse([line], places)
            except ValueError:
                return SceneFormatError(
                    f"{max(places) + 1} numbers in row {row:,} of {self.path}",
                    found=repr(line[:80]),
                    fix="Remove the line, or export the cloud again.",
                )
        return SceneFormatError(f"numbers in {self.path}", found="others", fix=COPY_AGAIN)

    def _blocks(self) -> Iterator[list[str]]:
        """The lines of numbers, a block at a time."""
        rest = b""
        with open_file(self.path) as file:
            file.seek(self.offset)
            while data := file.read(_BLOCK):
                whole, end, rest = (rest + data).rpartition(b"\n")
                if end:
                    yield _numbers(whole.decode("latin-1").split("\n"))
        yield _numbers([rest.decode("latin-1")])


def _numbers(lines: Sequence[str]) -> list[str]:
    """The lines that are neither empty nor comments."""
    return [s for line in lines if (s := line.strip()) and s[0] != "#"]
