"""PCD, the format of the Point Cloud Library: ascii, binary and binary_compressed.

Colours are ``rgb`` or ``rgba`` packed into 32 bits, or columns r, g, b; else intensity. Promise:
binary rows are read by offset. A compressed body is one LZF block by its definition, which has to
be in memory whole; its size is checked against the free memory first.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.rows import (
    COPY_AGAIN,
    XYZ,
    Columns,
    Painter,
    check_size,
    positions,
    read_rows,
    sample_rows,
)
from splatseed.io.clouds.tables import TextTable
from splatseed.io.files import open_file
from splatseed.process.memory import check_memory

_HEADER_BYTES = 1 << 16
_KINDS = {"F": "f", "I": "i", "U": "u"}
_PACKED = ("rgb", "rgba")
_TWICE = 2
"""A compressed body is in memory packed and unpacked."""


class PcdCloud(CloudFile):
    """A PCD file.

    Raises:
        SceneFormatError: It is not a PCD, has no x, y, z, or is cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_file(path) as file:
            header = _parse_header(path, file.read(_HEADER_BYTES))
        self._dtype, self.count, self._body, self._offset = header
        names = list(self._dtype.names or ())
        if not set(XYZ) <= set(names):
            raise _bad(path, "fields x, y and z", ", ".join(names) or "none")
        self._packed = next((name for name in _PACKED if name in names), None)
        columns = Columns() if self._packed else Columns.among(names)
        used = {*XYZ, self._packed, *columns.rgb, columns.intensity}
        if several := [name for name in names if name in used and self._dtype[name].shape]:
            raise _bad(path, "fields of one value (COUNT 1)", f"another COUNT of {several[0]}")
        self.colors = "rgb" if self._packed else columns.colors
        self._table: TextTable | None = None
        if self._body == "ascii":
            self._open_ascii(names, columns)
            return
        sample = self._sample()
        self._painter = Painter(columns, sample.__getitem__)

    def _open_ascii(self, names: list[str], columns: Columns) -> None:
        spread = [
            name if i == 0 else f"{name} {i}"
            for name in names
            for i in range(int(np.prod(self._dtype[name].shape, dtype=int)))
        ]
        if self._packed:  # one number: the bits of a float, or the integer itself
            columns = Columns((), self._packed)
        self._table = TextTable(self.path, spread, columns, self._offset, 0, self.count)

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        if self._table is not None:
            for chunk, column in self._table.tables(size):
                packed = None if self._packed is None else self._unpacked(column(self._packed))
                yield CloudChunk(chunk.xyz, chunk.rgb if packed is None else packed)
            return
        for column in self._columns(size):
            rgb = self._painter.paint(column)
            if self._packed is not None:
                rgb = self._unpacked(column(self._packed))
            yield CloudChunk(positions(column), rgb)

    def _columns(self, size: int) -> Iterator[Callable[[str], np.ndarray]]:
        assert self.count is not None  # noqa: S101  (of the header)
        if self._body == "binary":
            for rows in read_rows(self.path, self._dtype, self._offset, self.count, size):
                yield rows.__getitem__
            return
        columns = self._decompressed()
        for start in range(0, self.count, size):
            yield lambda name, at=start: columns[name][at : at + size]  # type: ignore[misc]  # bound at once

    def _sample(self) -> Any:
        assert self.count is not None  # noqa: S101  (of the header)
        if self._body == "binary":
            check_size(self.path, self._offset + self.count * self._dtype.itemsize)
            return sample_rows(self.path, self._dtype, self._offset, self.count)
        needs_range = not self._packed and self.colors != "none"
        return self._decompressed() if needs_range else {}

    def _unpacked(self, values: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
        """Colours from 32 bits 0xAARRGGBB, which may be declared as a float."""
        assert self._packed is not None  # noqa: S101  (the caller's)
        if self._dtype[self._packed].kind == "f":
            bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
        else:
            bits = np.asarray(values).astype(np.int64).astype(np.uint32)
        return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)

    def _decompressed(self) -> dict[str, np.ndarray]:
        """The columns of a compressed body, which holds them one after another."""
        from splatseed.io.clouds.lzf import decompress  # noqa: PLC0415  (loads Numba)

        assert self.count is not None  # noqa: S101  (of the header)
        needed = self.count * self._dtype.itemsize
        fix = "Save the cloud as a binary PCD or PLY, which is read in parts."
        check_memory(_TWICE * needed, 1, "bytes of a compressed PCD", fix=fix)
        with open_file(self.path) as file:
            file.seek(self._offset)
            room = self.path.stat().st_size - self._offset
            sizes = struct.unpack("<II", file.read(8)) if room >= 8 else (0, 0)
            packed = file.read(min(sizes[0], room))
        if len(packed) < sizes[0] or sizes[1] != needed:
            raise _bad(self.path, f"a compressed body of {needed:,} bytes", "another, or less")
        data = decompress(packed, needed)
        if data is None:
            raise _bad(self.path, "a body compressed by LZF", "bytes that are not")
        columns, at = {}, 0
        for name in self._dtype.names or ():
            kind = self._dtype[name]
            values = np.frombuffer(
                data, kind.base, self.count * kind.itemsize // kind.base.itemsize, at
            )
            columns[name] = values.reshape(self.count, -1)[:, 0] if kind.shape else values
            at += self.count * kind.itemsize
        return columns


def _parse_header(path: Path, data: bytes) -> tuple[np.dtype[Any], int, str, int]:
    """The layout of a row, the number of rows, the kind of the body, and where it begins."""
    known: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in known and (end := data.find(b"\n", at)) >= 0:
        words = data[at:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            known[words[0].upper()] = words[1:]
        at = end + 1
    try:
        names, sizes, kinds = known["FIELDS"], known["SIZE"], known["TYPE"]
        counts = [int(each) for each in known.get("COUNT", ["1"] * len(names))]
        codes = [f"<{_KINDS[kind]}{int(size)}" for kind, size in zip(kinds, sizes, strict=True)]
        fields: list[Any] = [
            (f"pad {i}" if name == "_" else name, code, *([(count,)] if count != 1 else []))
            for i, (name, code, count) in enumerate(zip(names, codes, counts, strict=True))
        ]
        rows = int(known["POINTS"][0]) if "POINTS" in known else _size(known)
        (body,) = (word.lower() for word in known["DATA"])
        dtype = np.dtype(fields)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise _bad(path, "a PCD header: FIELDS, SIZE, TYPE, POINTS, DATA", repr(error)) from None
    if body not in {"ascii", "binary", "binary_compressed"} or rows < 0:
        raise _bad(path, "DATA ascii, binary or binary_compressed", body)
    return dtype, rows, body, at


def _size(known: dict[str, list[str]]) -> int:
    return int(known["WIDTH"][0]) * int(known["HEIGHT"][0])


def _bad(path: Path, expected: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {path}", found=found[:160], fix=COPY_AGAIN)
