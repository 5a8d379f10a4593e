"""LAS and LAZ, by laspy with lazrs: survey scans.

Coordinates are float64 as the file's scale and offset have them. Colours are 16-bit by the standard
and 8-bit by habit: the values decide. Without colours, intensity. Points that the file marks as
withheld are left out. Promise: a LAZ file that ends early is an error, not a shorter cloud; what it
says of its chunks is checked before lazrs, which would end the process, allocates for it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.colors import SAMPLE_ROWS, ColorRange, GreyRange, sample_starts
from splatseed.io.clouds.rows import COPY_AGAIN, check_size, positions
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
        with _Opened(path) as file:
            header = file.header
            self.count = int(header.point_count)
            self.bounds = np.array([header.mins, header.maxs], np.float64)
            names = set(header.point_format.dimension_names)
            sample = _sample(file, path, self.count)
        self._names = names
        self._color = ColorRange()
        self._grey: GreyRange | None = None
        if names >= set(_RGB) and (sample.size == 0 or sample[:, :3].any()):
            self.colors = "rgb"
            self._color = ColorRange.of(sample[:, :3])
        elif sample.size and np.ptp(sample[:, 3]) > 0:
            self.colors = "intensity"
            self._grey = GreyRange.of(sample[:, 3])

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        given = 0
        with _Opened(self.path) as file:
            while given < (self.count or 0):
                points = _guarded(self.path, lambda: file.read_points(size))
                if not len(points):
                    raise _cut_short(self.path, f"{given:,} of {self.count:,} points")
                given += len(points)
                if len(chunk := self._chunk(points)):
                    yield chunk

    def _chunk(self, points: Any) -> CloudChunk:
        xyz = positions(points.__getitem__)
        rgb = None
        if self.colors == "rgb":
            rgb = self._color.to_bytes(np.stack([np.asarray(points[n]) for n in _RGB], axis=1))
        elif self._grey is not None:
            rgb = self._grey.to_bytes(np.asarray(points["intensity"]))
        chunk = CloudChunk(xyz, rgb)
        if "withheld" not in self._names:
            return chunk
        withheld = np.asarray(points["withheld"], bool)
        return chunk.select(~withheld) if withheld.any() else chunk


class _Opened:
    """A laspy reader whose failures are ours."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Any:
        import laspy  # noqa: PLC0415  (an optional package)

        _guarded(self.path, lambda: _check_records(self.path))
        self.reader = _guarded(self.path, lambda: laspy.open(self.path, read_evlrs=False))
        check = _check_chunks if self.reader.header.are_points_compressed else _check_room
        _guarded(self.path, lambda: check(self.path, self.reader.header))
        return self.reader

    def __exit__(self, *_: object) -> None:
        self.reader.close()


def _sample(file: Any, path: Path, count: int) -> np.ndarray:
    """Red, green, blue and intensity of points spread over the file, [n, 4]; 0 where absent."""
    parts = []
    names = set(file.header.point_format.dimension_names)
    for start in sample_starts(count):
        _guarded(path, lambda at=start: file.seek(at))  # type: ignore[misc]  # bound at once
        points = _guarded(path, lambda: file.read_points(SAMPLE_ROWS))
        table = np.zeros((len(points), 4), np.uint16)
        for i, name in enumerate((*_RGB, "intensity")):
            if name in names:
                table[:, i] = points[name]
        parts.append(table)
    return np.concatenate(parts) if parts else np.empty((0, 4), np.uint16)


def _check_records(path: Path) -> None:
    """Refuse a header that promises more in front of the points than the file holds.

    laspy makes room for all of it. Source: LAS 1.4 R15, tables 3 and 7.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(_WHERE_POINTS)
        start, number = struct.unpack("<II", file.read(8))
    if start > size:
        raise _cut_short(path, f"points that begin at byte {start:,} of {size:,}")
    if number * _RECORD > size:
        raise _cut_short(path, f"{number:,} records in {size:,} bytes")


def _check_room(path: Path, header: Any) -> None:
    """Refuse a LAS file with fewer bytes than its points take."""
    needed = header.offset_to_point_data + header.point_count * header.point_format.size
    check_size(path, needed)


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
        raise _cut_short(path, f"points of {vlr.item_size():,} bytes, not {bytes_each:,}")
    with path.open("rb") as file:
        number = _number_of_chunks(file, header.offset_to_point_data)
        # A chunk begins with a point as it is.
        if number * bytes_each > size:
            raise _cut_short(path, f"{number:,} chunks in {size:,} bytes")
        file.seek(header.offset_to_point_data)
        chunks = np.array(lazrs.read_chunk_table(file, vlr), np.float64).reshape(number, 2)
    points, packed = chunks.sum(axis=0)
    if packed > size or points < header.point_count:
        found = f"chunks of {points:,.0f} points in {packed:,.0f} bytes"
        raise _cut_short(path, f"{found}, for {header.point_count:,} points in {size:,} bytes")
    if chunks[:, 0].max() * bytes_each > _MOST_BYTES:
        raise _cut_short(path, f"a chunk of {chunks[:, 0].max():,.0f} points")


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


def _guarded(path: Path, read: Callable[[], Any]) -> Any:
    """What ``read`` gives; whatever the package raises on a bad file as our error."""
    try:
        return read()
    except (MemoryError, SplatseedError):
        raise
    except BaseException as error:  # laspy and lazrs raise errors of many kinds
        # A panic of Rust is no Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise _cut_short(path, f"one that is cut short or damaged ({reason})") from None


def _cut_short(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(f"{path} to be a complete LAS or LAZ file", found=found, fix=COPY_AGAIN)
