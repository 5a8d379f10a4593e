"""LAS and LAZ, by laspy with lazrs: survey scans.

Coordinates are float64 as the file's scale and offset have them. Colours are 16-bit by the standard
and 8-bit by habit: the values decide. Without colours, intensity. Points that the file marks as
withheld are left out. Promise: a LAZ file that ends early is an error, not a shorter cloud; what it
says of its chunks is checked before lazrs, which would end the process, allocates for it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from splatseed.io.cloud_file import (
    CHUNK,
    SAMPLE_ROWS,
    CloudChunk,
    CloudFile,
    Column,
    Columns,
    Painter,
    check_size,
    sample_starts,
)
from splatseed.io.files import guarded
from splatseed.requirements import require

_RGB = ("red", "green", "blue")
_WHERE_POINTS, _RECORD = 96, 54
"""Where a header has the offset of the points, followed by the number of variable length records;
bytes of each of these, at least."""
_MOST_BYTES = 1 << 30
"""Of a chunk of points, unpacked; writers use 50,000 points, of 20 to some 100 bytes."""


class LasCloud(CloudFile):
    """A LAS or LAZ file.

    Raises:
        MissingDependencyError: laspy or lazrs is not installed.
        SceneFormatError: It is not LAS, or cut short.
    """

    def __init__(self, path: Path) -> None:
        require("laspy", "lazrs")
        self.path = path
        with _opened(path) as file:
            self.count = int(file.header.point_count)
            self.bounds = np.array([file.header.mins, file.header.maxs], np.float64)
            names = set(file.header.point_format.dimension_names)
            there = [name for name in (*_RGB, "intensity") if name in names]
            sample = {name: [np.empty(0, np.uint16)] for name in there}
            for start in sample_starts(self.count):
                file.seek(start)
                points = file.read_points(SAMPLE_ROWS)
                for name in there:
                    sample[name].append(np.asarray(points[name], np.uint16))
        columns = Columns()
        known = {name: np.concatenate(parts) for name, parts in sample.items()}
        if set(_RGB) <= names and (not self.count or any(known[name].any() for name in _RGB)):
            columns = Columns(_RGB)
        elif len(known.get("intensity", ())) and np.ptp(known["intensity"]) > 0:
            columns = Columns((), "intensity")
        self.colors = columns.colors
        self._painter = Painter(columns, lambda: known.__getitem__)
        self._marks_withheld = "withheld" in names

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        given, count = 0, self.count or 0
        with _opened(self.path) as file:
            while given < count:
                points = file.read_points(size)
                if not len(points):
                    raise ValueError(f"{given:,} of {count:,} points")
                given += len(points)
                column: Column = points.__getitem__
                chunk = self._painter.chunk(lambda name, of=column: np.asarray(of(name)))  # type: ignore[misc]  # bound at once
                if self._marks_withheld:
                    chunk = chunk.select(~np.asarray(points["withheld"], bool))
                if len(chunk):
                    yield chunk


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A laspy reader; what it raises becomes one of our errors."""
    import laspy  # noqa: PLC0415  (an optional package)

    with guarded(path, "a complete LAS or LAZ file"):
        _check_records(path)
        with laspy.open(path, read_evlrs=False) as reader:
            header = reader.header
            if header.are_points_compressed:
                _check_chunks(path, header)
            else:
                bodies = header.point_count * header.point_format.size
                check_size(path, header.offset_to_point_data + bodies)
            yield reader


def _check_records(path: Path) -> None:
    """Refuse a header that promises more in front of the points than the file holds.

    laspy makes room for all of it. Source: LAS 1.4 R15, tables 3 and 7.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(_WHERE_POINTS)
        start, number = struct.unpack("<II", file.read(8))
    if start > size or number * _RECORD > size:
        raise ValueError(f"{number:,} records and points from byte {start:,} in {size:,} bytes")


def _check_chunks(path: Path, header: Any) -> None:
    """Refuse a LAZ file whose description or table of chunks cannot be true.

    Source: the LAZ specification (rapidlasso), "LASzip VLR" and "Chunk table".
    """
    import lazrs  # noqa: PLC0415  (an optional package)

    if not header.point_count:
        return  # there need not be a table
    size, bytes_each = path.stat().st_size, header.point_format.size
    vlr = lazrs.LazVlr(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    if vlr.item_size() != bytes_each:
        raise ValueError(f"points of {vlr.item_size():,} bytes, not {bytes_each:,}")
    with path.open("rb") as file:
        number = _number_of_chunks(file, header.offset_to_point_data)
        # A chunk begins with a point as it is.
        if number * bytes_each > size:
            raise ValueError(f"{number:,} chunks in {size:,} bytes")
        file.seek(header.offset_to_point_data)
        chunks = np.array(lazrs.read_chunk_table(file, vlr), np.float64).reshape(number, 2)
    points, packed = chunks.sum(axis=0)
    if (
        packed > size
        or points < header.point_count
        or chunks[:, 0].max() * bytes_each > _MOST_BYTES
    ):
        found = f"chunks of {points:,.0f} points in {packed:,.0f} bytes"
        raise ValueError(f"{found}, for {header.point_count:,} points in {size:,} bytes")


def _number_of_chunks(file: IO[bytes], start: int) -> int:
    """The number that stands before the table of chunks."""
    file.seek(start)
    (offset,) = struct.unpack("<q", file.read(8))
    if offset <= start:  # written in one go: the offset follows the table
        file.seek(-8, os.SEEK_END)
        (offset,) = struct.unpack("<q", file.read(8))
    file.seek(offset)
    _, number = struct.unpack("<II", file.read(8))
    return int(number)
