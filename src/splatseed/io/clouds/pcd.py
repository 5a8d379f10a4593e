"""PCD files of the Point Cloud Library: ascii, binary and binary_compressed.

Colours are ``rgb`` or ``rgba`` packed into 32 bits, or columns r, g, b; else intensity. A
compressed body is one LZF block that must fit in memory. (pypcd4 would load every body at once and
needs two more packages.)
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.io.cloud_file import PACKED_RGB, XYZ, Block, CloudFile, LineCloud, RowCloud
from splatseed.io.clouds._kernels import decompress_lzf
from splatseed.io.files import open_file, translate_errors
from splatseed.runtime.memory import check_memory

_HEADER_BYTES = 1 << 16
_MAX_PACKED, _PACKED_GREY = 2**32 - 1, 0x808080
_KINDS = {"F": "f", "I": "i", "U": "u"}


def open_pcd(path: Path) -> CloudFile:
    """Open a PCD file."""
    with translate_errors(path, "a PCD: FIELDS, SIZE, TYPE, POINTS, DATA"), open_file(path) as file:
        dtype, rows, body, offset = _parse_header(file.read(_HEADER_BYTES))
    if body == "binary":
        return RowCloud(path, dtype, offset, rows)
    if body == "binary_compressed":
        return _ColumnCloud(path, _decompressed(path, dtype, rows, offset), rows)
    fields = [(name, int(np.prod(dtype[name].shape, dtype=int))) for name in dtype.names or ()]
    names = [name if i == 0 else f"{name} {i}" for name, count in fields for i in range(count)]
    types = {PACKED_RGB: dtype[PACKED_RGB]} if PACKED_RGB in names else {}
    if types and dtype[PACKED_RGB].kind == "f":
        return _FloatColorLines(path, names, offset, rows)
    return LineCloud(path, names, offset, rows, types=types)


class _FloatColorLines(LineCloud):
    """Lines whose packed colours are floats, or the integers of the same bits.

    The bits of an opaque colour are a NaN as a float, so some writers print the integer; of a NaN
    the colour is lost, and grey.
    """

    def _block(self, lines: Sequence[str], num_before: int) -> Block:
        block = dict(super()._block(lines, num_before))
        packed = np.asarray(block[PACKED_RGB])
        whole = packed >= 1  # as a float a colour without its unused byte is below 1e-37
        bits = packed.astype(np.float32).view(np.uint32)
        bits[whole] = np.minimum(packed[whole], _MAX_PACKED).astype(np.uint32)
        bits[np.isnan(packed)] = _PACKED_GREY
        return {**block, PACKED_RGB: bits}


class _ColumnCloud(CloudFile):
    """Columns in memory."""

    def __init__(self, path: Path, columns: dict[str, np.ndarray], count: int) -> None:
        super().__init__(path, columns, count)
        self._columns = columns

    def _blocks(self, size: int) -> Iterator[Block]:
        for start in range(0, len(self._columns["x"]), size):
            yield {name: self._columns[name][start : start + size] for name in self.used}

    def _sample(self) -> Block:
        return self._columns


def _parse_header(data: bytes) -> tuple[np.dtype[Any], int, str, int]:
    """Parse a header: dtype of a row, number of rows, format and offset of the body."""
    known: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in known and (end := data.find(b"\n", at)) >= 0:
        fields = data[at:end].decode("latin-1").split()
        if fields and not fields[0].startswith("#"):
            known[fields[0].upper()] = fields[1:]  # PCL reads keys and types in any case
        at = end + 1
    names, sizes = [name.lower() for name in known["FIELDS"]], known["SIZE"]
    kinds = [kind.upper() for kind in known["TYPE"]]
    counts = [int(each) for each in known.get("COUNT", ["1"] * len(names))]
    packed = next((name for name in ("rgb", "rgba") if name in names), None)
    layout: list[Any] = []
    for i, (name, kind, size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True)):
        known_as = (
            f"pad {i}" if name == "_" else PACKED_RGB if (name, size) == (packed, "4") else name
        )
        shape = () if count == 1 else (count,)
        layout.append(
            (f"{known_as}[]" if shape else known_as, f"<{_KINDS[kind]}{int(size)}", shape)
        )
    if missing := set(XYZ) - {name for name, *_ in layout}:
        raise ValueError(f"no fields {', '.join(sorted(missing))} of one value (COUNT 1)")
    size_keys = ["POINTS"] if "POINTS" in known else ["WIDTH", "HEIGHT"]
    rows = math.prod(int(known[key][0]) for key in size_keys)
    (body,) = (value.lower() for value in known["DATA"])
    if body not in {"ascii", "binary", "binary_compressed"} or rows < 0:
        raise ValueError(f"{rows} points, DATA {body}")
    return np.dtype(layout), rows, body, at


def _decompressed(
    path: Path, dtype: np.dtype[Any], rows: int, offset: int
) -> dict[str, np.ndarray]:
    needed = rows * dtype.itemsize
    fix = "Save the cloud as a binary PCD or PLY, which is read in chunks."
    # Both compressed and decompressed bytes are in memory.
    check_memory(2 * needed, 1, "bytes of a compressed PCD", fix=fix)
    with translate_errors(path, "a PCD compressed by LZF"), open_file(path) as file:
        file.seek(offset)
        size, promised = struct.unpack("<II", file.read(8))
        packed = file.read(min(size, path.stat().st_size))
        if len(packed) < size or promised != needed:
            raise ValueError(f"{len(packed):,} bytes for {needed:,}")
        data = np.empty(needed, np.uint8)
        if not decompress_lzf(np.frombuffer(packed, np.uint8), data):
            raise ValueError("a damaged LZF block")
    columns, at = {}, 0
    for name in dtype.names or ():
        stop = at + rows * dtype[name].itemsize
        if not dtype[name].shape:
            columns[name] = data[at:stop].view(dtype[name])
        at = stop
    return columns
