"""PCD, the format of the Point Cloud Library: ascii, binary and binary_compressed.

Colours are ``rgb`` or ``rgba`` packed into 32 bits, or columns r, g, b; else intensity. Promise:
binary rows are read by offset. A compressed body is one LZF block by its definition, which has to
be in memory whole; its size is checked against the free memory first. (pypcd4 reads every body
whole and needs two more packages.)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.cloud_file import (
    CHUNK,
    XYZ,
    CloudChunk,
    CloudFile,
    Column,
    Columns,
    Painter,
    RowTable,
    TextTable,
    positions,
)
from splatseed.io.files import COPY_AGAIN, guarded, open_file
from splatseed.runtime.jit import inline
from splatseed.runtime.memory import check_memory

_HEADER_BYTES = 1 << 16
_KINDS = {"F": "f", "I": "i", "U": "u"}
_PACKED = ("rgb", "rgba")


@dataclass(frozen=True)
class _Header:
    """The layout of a row, the number of rows, the kind of the body, and where it begins."""

    dtype: np.dtype[Any]
    rows: int
    body: str
    offset: int


@dataclass(frozen=True)
class _UnpackedTable:
    """The columns of a compressed body, which holds them one after another."""

    data: dict[str, np.ndarray]
    count: int

    def columns(self, size: int) -> Iterator[Column]:
        """The rows, at most ``size`` at a time."""
        for start in range(0, self.count, size):
            yield lambda name, at=start: self.data[name][at : at + size]  # type: ignore[misc]  # bound at once

    def sample(self) -> Column:
        """All rows."""
        return self.data.__getitem__


class PcdCloud(CloudFile):
    """A PCD file.

    Raises:
        SceneFormatError: It is not a PCD, has no x, y, z, or is cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with guarded(path, "a PCD: FIELDS, SIZE, TYPE, POINTS, DATA"), open_file(path) as file:
            header = _parse_header(file.read(_HEADER_BYTES))
        dtype, self.count = header.dtype, header.rows
        names = list(dtype.names or ())
        self._packed = next((name for name in _PACKED if name in names), None)
        columns = Columns() if self._packed else Columns.among(names)
        self.colors = "rgb" if self._packed else columns.colors
        optional = (self._packed, columns.intensity)
        used = (*XYZ, *columns.rgb, *(name for name in optional if name))
        wrong = [name for name in used if name not in names or dtype[name].shape]
        if wrong:
            raise SceneFormatError(
                f"fields {', '.join(used)} of one value (COUNT 1) in {path}",
                found=f"none, or another COUNT, of {wrong[0]}",
                fix=COPY_AGAIN,
            )
        self._is_float = self._packed is not None and dtype[self._packed].kind == "f"
        self._table: RowTable | TextTable | _UnpackedTable
        if header.body == "ascii":
            shapes = {name: int(np.prod(dtype[name].shape, dtype=int)) for name in names}
            spread = [
                name if i == 0 else f"{name} {i}" for name in names for i in range(shapes[name])
            ]
            self._table = TextTable(path, spread, used, header.offset, self.count)
        elif header.body == "binary":
            self._table = RowTable(path, dtype, header.offset, self.count)
        else:
            self._table = _decompressed(path, header)
        self._painter = Painter(columns, self._table.sample)

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        for column in self._table.columns(size):
            if self._packed is None:
                yield self._painter.chunk(column)
            else:
                yield CloudChunk(positions(column), self._unpacked(column(self._packed)))

    def _unpacked(self, values: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
        """Colours from 32 bits 0xAARRGGBB, which may be declared as a float."""
        if self._is_float:
            bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
        else:
            bits = np.asarray(values).astype(np.int64).astype(np.uint32)
        return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)


def _parse_header(data: bytes) -> _Header:
    known: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in known and (end := data.find(b"\n", at)) >= 0:
        words = data[at:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            known[words[0].upper()] = words[1:]
        at = end + 1
    names, sizes, kinds = known["FIELDS"], known["SIZE"], known["TYPE"]
    counts = [int(each) for each in known.get("COUNT", ["1"] * len(names))]
    fields: list[Any] = [
        (f"pad {i}" if name == "_" else name, f"<{_KINDS[kind]}{int(size)}", *shape)
        for i, (name, kind, size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True))
        if (shape := ((count,),) if count != 1 else ()) is not None
    ]
    size = int(known["WIDTH"][0]) * int(known["HEIGHT"][0]) if "POINTS" not in known else 0
    rows = int(known["POINTS"][0]) if "POINTS" in known else size
    (body,) = (word.lower() for word in known["DATA"])
    if body not in {"ascii", "binary", "binary_compressed"} or rows < 0:
        raise ValueError(f"{rows} points, DATA {body}")
    return _Header(np.dtype(fields), rows, body, at)


def _decompressed(path: Path, header: _Header) -> _UnpackedTable:
    needed = header.rows * header.dtype.itemsize
    fix = "Save the cloud as a binary PCD or PLY, which is read in parts."
    # It is in memory packed and unpacked.
    check_memory(2 * needed, 1, "bytes of a compressed PCD", fix=fix)
    with guarded(path, "a PCD compressed by LZF"), open_file(path) as file:
        file.seek(header.offset)
        size, promised = struct.unpack("<II", file.read(8))
        packed = file.read(min(size, path.stat().st_size))
        if len(packed) < size or promised != needed:
            raise ValueError(f"{len(packed):,} bytes for {needed:,}")
        data = np.empty(needed, np.uint8)
        decode: Any = _decompress
        if not decode(np.frombuffer(packed, np.uint8), data):
            raise ValueError("bytes that are not")
    columns, at = {}, 0
    for name in header.dtype.names or ():
        kind = header.dtype[name]
        stop = at + header.rows * kind.itemsize
        values = data[at:stop].view(kind.base)
        columns[name] = values.reshape(header.rows, -1)[:, 0] if kind.shape else values
        at = stop
    return _UnpackedTable(columns, header.rows)


@inline
def _decompress(packed, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202  (Numba infers)
    """Fill ``out`` from an LZF block; whether the block holds exactly so many bytes.

    A block is a row of runs. A byte c below 32 is followed by c + 1 bytes as they are; any other
    begins a reference: its upper 3 bits plus 2 are the length (7: plus the next byte), its lower 5
    bits and the last byte the distance back, minus 1.
    """
    i, o, num, size = 0, 0, len(packed), len(out)
    while i < num:
        c = int(packed[i])
        i += 1
        if c < 32:
            length = c + 1
            if i + length > num or o + length > size:
                return False
            for k in range(length):
                out[o + k] = packed[i + k]
            i += length
        else:
            length = (c >> 5) + 2
            if length == 9 and i < num:
                length += int(packed[i])
                i += 1
            if i >= num:
                return False
            back = o - ((c & 31) << 8) - int(packed[i]) - 1
            i += 1
            if back < 0 or o + length > size:
                return False
            for k in range(length):  # may overlap what it writes
                out[o + k] = out[back + k]
        o += length
    return o == size
