"""Point files read in chunks: the reader interface, and tables of binary rows and text lines.

A *block* is consecutive rows (points) as columns by name. Colours are scaled by their white level:
1 for floats, or that of 8, 10, 12 or 16 bits. It is detected from values, not types, since many
writers store 8-bit values in 16 bits; a sample of the file is read first, so that results do not
depend on the chunk size.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Shaped, UInt8

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import COPY_AGAIN, open_file

CHUNK = 1 << 20
"""Default rows per chunk; reading one takes 50 to 100 MB."""
Block: TypeAlias = Mapping[str, Any] | np.ndarray
XYZ = ("x", "y", "z")
RGB = ("red", "green", "blue")
PACKED_RGB = "packed rgb"
"""A column of four bytes: blue, green, red, unused."""
SAMPLES, SAMPLE_ROWS, SAMPLE_BYTES = 16, 4096, 1 << 16
"""Number of samples for finding value ranges, and rows or bytes of text in each."""

_SH_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
_SH0 = 0.28209479177387814  # 1 / (2 sqrt(pi)); colour = 0.5 + SH0 * f_dc in 3DGS
_RGB_NAMES = (
    *((PACKED_RGB,), RGB, ("diffuse_red", "diffuse_green", "diffuse_blue")),
    *(("r", "g", "b"), _SH_NAMES),
)
_INTENSITY_NAMES = ("intensity", "reflectance", "reflectivity")
_GREY = 128
_WHITES = (255.0, 1023.0, 4095.0, 65535.0)
"""White of 8, 10, 12 and 16 bits."""
_FLOAT_QUANTILE, _OVERSHOOT = 0.999, 2.0
"""Quantile of colours in floats, and how far it may be above their white."""
_BLACK_PERCENTILE, _WHITE_PERCENTILE = 1.0, 99.0
"""Percentiles of intensity mapped to black and white; few specular points can dominate a scan."""
_TEXT_BYTES = 1 << 22
"""Bytes of text per read."""


@dataclass(frozen=True, eq=False)
class CloudChunk:
    """Consecutive points of a file.

    ``xyz`` are in the file's coordinates and may be NaN or infinite. ``rgb`` are grey if the file
    only has intensity, None if it has neither.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def finite(self) -> Bool[np.ndarray, " n"]:
        """Whether each point has finite coordinates."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    def select(self, which: np.ndarray | slice) -> CloudChunk:
        """Select points by a mask, indices or a slice."""
        return CloudChunk(self.xyz[which], None if self.rgb is None else self.rgb[which])


class CloudFile(ABC):
    """A point file, opened but not yet read; formats implement ``_blocks`` and ``_sample``.

    Attributes:
        path: The file.
        count: Rows by the header; None if unknown. ``chunks`` may yield fewer points, since rows
            marked invalid are skipped.
        findings: Problems of the file.
        may_be_linear: Whether colours may be linear, as the format says, or sRGB, as many write.
        used: Names of the columns that are read: positions and colours.
    """

    findings: tuple[Finding, ...] = ()
    may_be_linear = False

    def __init__(self, path: Path, names: Iterable[str], count: int | None = None) -> None:
        self.path, self.count = path, count
        there = set(names)
        self._rgb = next((each for each in _RGB_NAMES if set(each) <= there), ())
        intensity = next((each for each in _INTENSITY_NAMES if each in there), None)
        self._intensity = None if self._rgb else intensity
        self.used = (*XYZ, *self._rgb, *([self._intensity] if self._intensity else []))
        self._range: tuple[float, float] | None = None

    @abstractmethod
    def _blocks(self, size: int) -> Iterator[Block]:
        """Yield the used columns, at most ``size`` rows at a time, in file order."""

    @abstractmethod
    def _sample(self) -> Block:
        """Return the used columns of rows spread over the file."""

    @property
    def colors(self) -> Literal["rgb", "intensity", "none"]:
        """Source of colours."""
        return "rgb" if self._rgb else "intensity" if self._intensity else "none"

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """Yield the points in file order, at most ``size`` at a time; no chunk is empty."""
        if self.colors != "none" and self._range is None:
            self._range = self._range_of(self._sample())
        for block in self._blocks(size):
            if len(block["x"]):
                yield self._chunk(block, self._range)

    def read_all(self) -> CloudChunk:
        """Read all points; the white level is that of all rows, and intensity is ignored."""
        blocks = list(self._blocks(max(self.count or 0, 1)))  # one block, or none
        if not blocks:
            return CloudChunk(np.empty((0, 3)))
        return self._chunk(blocks[0], self._range_of(blocks[0]) if self._rgb else None)

    def _range_of(self, sample: Block) -> tuple[float, float]:
        """Return the values that become black and white."""
        if self._rgb:
            return 0.0, white_level(_columns(sample, self._rgb))
        known = np.asarray(sample[str(self._intensity)], np.float64)
        known = known[np.isfinite(known)]
        low, high = (
            np.percentile(known, (_BLACK_PERCENTILE, _WHITE_PERCENTILE))
            if known.size
            else (0.0, 1.0)
        )
        return float(low), float(high) if high > low else float(low) + 1.0

    def _chunk(self, block: Block, between: tuple[float, float] | None) -> CloudChunk:
        with np.errstate(invalid="ignore", over="ignore"):  # damaged ones may not be finite
            xyz = np.stack([np.asarray(block[name], np.float64) for name in XYZ], axis=1)
        if between is None:
            return CloudChunk(xyz)
        low, high = between
        if self._intensity:
            values = np.asarray(block[self._intensity], np.float64)
            grey = to_uint8((values - low) / (high - low), 1.0)
            return CloudChunk(xyz, np.repeat(grey[:, None], 3, axis=1))
        values = _columns(block, self._rgb)
        if self._rgb == _SH_NAMES:
            return CloudChunk(xyz, to_uint8(0.5 + _SH0 * values.astype(np.float64), 1.0))
        return CloudChunk(xyz, to_uint8(values, high))


def _columns(block: Block, names: Sequence[str]) -> np.ndarray:
    if names == (PACKED_RGB,):
        return np.ascontiguousarray(block[PACKED_RGB]).view(np.uint8).reshape(-1, 4)[:, 2::-1]
    return np.stack([np.asarray(block[name]) for name in names], axis=1)


def white_level(sample: Shaped[np.ndarray, "..."]) -> float:
    """Detect the value that means 255 from a sample of colours.

    Floats may exceed it: filters and interpolation overshoot, and a few values may be damaged.
    """
    known = np.asarray(sample, np.float64).ravel()
    known = known[np.isfinite(known)]
    if sample.dtype == np.uint8 or not known.size:
        return 255.0
    is_float = sample.dtype.kind == "f"
    largest = np.quantile(known, _FLOAT_QUANTILE) / _OVERSHOOT if is_float else known.max()
    whites = [*([1.0] if is_float else []), *_WHITES]
    return next((white for white in whites if largest <= white), _WHITES[-1])


def to_uint8(values: Shaped[np.ndarray, "..."], full: float) -> UInt8[np.ndarray, "..."]:
    """Convert colours of any numeric type to bytes, rounded; ``full`` becomes 255."""
    if values.dtype == np.uint8:
        return np.ascontiguousarray(values)
    known = np.nan_to_num(np.asarray(values, np.float64) * (255.0 / full), nan=_GREY)
    return np.asarray(np.clip(np.rint(known), 0, 255).astype(np.uint8))


def check_min_size(path: Path, needed: int) -> None:
    """Raise ``SceneFormatError`` if a file has fewer bytes than its header requires."""
    size = path.stat().st_size
    if size < needed:
        raise SceneFormatError(
            f"{path} to have {needed:,} bytes, as its header promises",
            found=f"{size:,}: the file is truncated",
            fix=COPY_AGAIN,
        )


def sample_starts(count: int) -> list[int]:
    """Return the first rows of samples spread over ``count`` rows."""
    last = max(count - SAMPLE_ROWS, 0)
    return sorted({last * i // (SAMPLES - 1) for i in range(SAMPLES)}) if count else []


class RowCloud(CloudFile):
    """Binary rows of fixed length, read by offset."""

    def __init__(self, path: Path, dtype: np.dtype[Any], offset: int, count: int) -> None:
        super().__init__(path, dtype.names or (), count)
        check_min_size(path, offset + count * dtype.itemsize)
        self.num_rows, self._dtype, self._offset = count, dtype, offset

    def _blocks(self, size: int) -> Iterator[np.ndarray]:
        for start in range(0, self.num_rows, size):
            yield self.rows(start, size)

    def _sample(self) -> np.ndarray:
        parts = [self.rows(start, SAMPLE_ROWS) for start in sample_starts(self.num_rows)]
        return np.concatenate([np.empty(0, self._dtype), *parts])

    def rows(self, start: int, size: int) -> np.ndarray:
        """Read rows from ``start``, at most ``size``."""
        wanted = min(size, self.num_rows - start)
        with open_file(self.path) as file:
            file.seek(self._offset + start * self._dtype.itemsize)
            return np.frombuffer(file.read(wanted * self._dtype.itemsize), self._dtype, wanted)


@dataclass(frozen=True)
class Dialect:
    """How a line is written: delimiter (None: whitespace) and decimal comma."""

    delimiter: str | None = None
    decimal_comma: bool = False

    def parse(self, lines: Sequence[str], places: Sequence[int]) -> Float64[np.ndarray, "n C"]:
        """Parse the columns ``places`` of each line; raise ``ValueError`` if one is no number."""
        if self.decimal_comma:
            lines = [line.replace(",", ".") for line in lines]
        quote = '"' if lines and '"' in lines[0] else None
        return np.loadtxt(
            lines, np.float64, comments=None, delimiter=self.delimiter, usecols=places, ndmin=2,
            quotechar=quote,
        )  # fmt: skip


def sample_lines(path: Path, offset: int, *, counts: bool = False) -> list[str]:
    """Return lines spread over a file from ``offset`` on; ``counts`` as of ``LineCloud``."""
    last = path.stat().st_size - SAMPLE_BYTES
    places = {max(offset, offset + (last - offset) * i // (SAMPLES - 1)) for i in range(SAMPLES)}
    lines: list[str] = []
    with open_file(path) as file:
        for place in sorted(places):
            file.seek(place)
            block = file.read(SAMPLE_BYTES).decode("latin-1").split("\n")
            lines += _numbers(block[place > offset : -1] or block[:1], counts=counts)
    return lines


class LineCloud(CloudFile):
    """Lines of numbers (XYZ, CSV, ascii PLY and PCD), read in blocks.

    With ``counts``, lines of one number are not points but numbers of points, as PTS files have.
    """

    def __init__(
        self,
        path: Path,
        names: Sequence[str],
        offset: int = 0,
        count: int | None = None,
        *,
        dialect: Dialect | None = None,
        types: Mapping[str, np.dtype[Any]] | None = None,
        counts: bool = False,
    ) -> None:
        super().__init__(path, names, count)
        self._counts = counts
        self._places = [names.index(name) for name in self.used]
        self._offset, self._dialect, self._types = offset, dialect or Dialect(), types or {}

    def _blocks(self, size: int) -> Iterator[Block]:
        num_read, lines = 0, islice(chain.from_iterable(self._lines()), self.count)
        while rows := list(islice(lines, size)):
            yield self._block(rows, num_read)
            num_read += len(rows)
        if self.count is not None and num_read < self.count:
            raise SceneFormatError(
                f"{self.count:,} points in {self.path}, as its header promises",
                found=f"{num_read:,}: the file is truncated",
                fix=COPY_AGAIN,
            )

    def _sample(self) -> Block:
        lines = sample_lines(self.path, self._offset, counts=self._counts)
        return self._block(lines[: self.count], 0)

    def _block(self, lines: Sequence[str], num_before: int) -> Block:
        """Parse lines that follow ``num_before`` others."""
        table = np.empty((0, len(self._places)))
        try:
            table = self._dialect.parse(lines, self._places) if lines else table
        except ValueError:
            wrong = next((i for i, line in enumerate(lines) if not self._parses(line)), 0)
            raise SceneFormatError(
                f"{max(self._places) + 1} numbers in row {num_before + wrong + 1:,} of {self.path}",
                found=repr(lines[wrong][:80]),
                fix="Remove the line, or export the cloud again.",
            ) from None
        block: dict[str, np.ndarray] = dict(zip(self.used, table.T, strict=True))
        with np.errstate(invalid="ignore", over="ignore"):
            for name in block.keys() & self._types.keys():
                kind = self._types[name]
                values = block[name] if kind.kind == "f" else block[name].astype(np.int64)
                if kind == np.uint8 and (values != values.astype(kind)).any():
                    wrong = int((values != values.astype(kind)).argmax())
                    raise SceneFormatError(
                        f"{name} from 0 to 255 in row {num_before + wrong + 1:,} of {self.path}",
                        found=f"{values[wrong]}",
                        fix="Correct the row, or export the cloud again.",
                    )
                block[name] = values.astype(kind)
        return block

    def _parses(self, line: str) -> bool:
        with suppress(ValueError):
            return bool(self._dialect.parse([line], self._places).size)
        return False

    def _lines(self) -> Iterator[list[str]]:
        rest = b""
        with open_file(self.path) as file:
            file.seek(self._offset)
            while data := file.read(_TEXT_BYTES):
                whole, end, rest = (rest + data).rpartition(b"\n")
                if end:
                    yield _numbers(whole.decode("latin-1").split("\n"), counts=self._counts)
        yield _numbers([rest.decode("latin-1")], counts=self._counts)


def _numbers(lines: Sequence[str], *, counts: bool) -> list[str]:
    """Drop empty lines, comments and, with ``counts``, numbers of points."""
    kept = [s for line in lines if (s := line.strip()) and s[0] not in "#/"]
    return [line for line in kept if not line.isdecimal()] if counts else kept
