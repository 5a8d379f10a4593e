"""Depth maps stored as arrays: NumPy's ``.npy`` and ``.npz``, ``.pfm``, COLMAP's ``.bin``.

Notation: a stored map is H x W numbers, top row first, still in the file's own units. Promise: a
header is checked against the bytes that follow before anything is allocated for it, no pickle is
loaded, and every failure is a ``SceneFormatError`` that names the file.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, get_args

import numpy as np
from numpy.lib import format as npy_format

from splatseed.depthmap import DepthKind
from splatseed.errors import SceneFormatError
from splatseed.io.files import ARCHIVE_FAILURES, ARRAY_FAILURES, read_bytes
from splatseed.literal import beginning, told

KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
"""NumPy kinds of real numbers."""
MAX_PIXELS = 2**28
"""The largest plausible map: a header that promises more is damaged or hostile."""

_NPY_HEADERS = {
    (1, 0): npy_format.read_array_header_1_0,
    (2, 0): npy_format.read_array_header_2_0,
}
_MOST_INFLATED = 100
"""How many times larger than in its archive a map can be: measured values hardly compress."""
_SMALL = 1 << 26
"""Maps of up to this many bytes are harmless at any compression: a map can be constant."""
_NPZ_KEYS = ("depth", "arr_0")
_PFM_HEADER = re.compile(rb"(P[fF])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,32})[ \t]*\r?\n")
_BIN_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")
_FLOAT = np.dtype("<f4")


class StoredDepth(NamedTuple):
    """A map as stored in its file.

    Args:
        values: Real numbers [H, W].
        kind: What the values are, if the file says so; else None.
    """

    values: np.ndarray
    kind: DepthKind | None = None


def read_npy(path: Path) -> StoredDepth:
    """Read an array of NumPy's; [H, W], or with an axis of length 1 before or after.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not an array of real numbers of that shape.
    """
    return StoredDepth(_as_map(path, _parse_npy(path, read_bytes(path))))


def read_npz(path: Path) -> StoredDepth:
    """Read an archive of NumPy's: the array ``depth``, else ``arr_0``, else the only one.

    A text ``kind`` in it ("z", "ray" or "inverse") says what the values are.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It holds no such array.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
            names = {n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy")}
            kind = _kind_of(path, _member(path, archive, "kind") if "kind" in names else None)
            wanted = _wanted(path, names - {"kind"})
            return StoredDepth(
                _as_map(path, _parse_npy(path, _member(path, archive, wanted))), kind
            )
    except ARCHIVE_FAILURES as error:
        refuse(path, "the archive of np.savez", told(error))


def read_pfm(path: Path) -> StoredDepth:
    """Read a portable float map of one channel (Debevec's format; rows are kept bottom first).

    The sign of its scale is the byte order; its size is not used.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no such map, or its size is not what its header promises.
    """
    data = read_bytes(path)
    header = _PFM_HEADER.match(data)
    if header is None or header[1] != b"Pf":
        refuse(path, "a one-channel float map (Pf)", beginning(data))
    try:
        scale = float(header[4])
    except ValueError:
        scale = 0.0
    if not (math.isfinite(scale) and scale):
        refuse(path, "a scale whose sign is the byte order", beginning(header[4]))
    dtype = _FLOAT if scale < 0 else _FLOAT.newbyteorder(">")
    shape = (int(header[3]), int(header[2]))
    return StoredDepth(_body(path, data, header.end(), shape, dtype)[::-1])


def read_colmap_depth(path: Path) -> StoredDepth:
    """Read a depth map of COLMAP's dense stereo: ``W&H&1&``, then float32 rows (mvs/mat.h).

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no such map, or its size is not what its header promises.
    """
    data = read_bytes(path)
    header = _BIN_HEADER.match(data)
    if header is None or int(header[3]) != 1:
        refuse(path, "a depth map of COLMAP's (W&H&1&)", beginning(data))
    shape = (int(header[2]), int(header[1]))
    return StoredDepth(_body(path, data, header.end(), shape, _FLOAT))


def check_stored(path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Check that a file's array can be a depth map: not empty, not absurd, real numbers.

    Raises:
        SceneFormatError: It cannot.
    """
    if len(shape) != 2 or not 0 < math.prod(shape) <= MAX_PIXELS:
        refuse(path, "height x width values", "x".join(map(str, shape)) or "one number")
    if dtype.kind not in "uif":
        refuse(path, "real numbers", str(dtype))


def refuse(path: Path, expected: str, found: str) -> NoReturn:
    """Raise what a damaged or foreign file deserves."""
    raise SceneFormatError(
        f"{path} to be a depth map with {expected}", found=found, fix="Export the file again."
    )


def _body(
    path: Path, data: bytes, start: int, shape: tuple[int, int], dtype: np.dtype[Any]
) -> np.ndarray:
    """The values that follow a header, a view of the file's bytes."""
    check_stored(path, shape, dtype)
    promised = math.prod(shape) * dtype.itemsize
    if len(data) - start != promised:
        size = f"{shape[1]} x {shape[0]}"
        refuse(path, f"{promised} bytes for {size} values", f"{len(data) - start}")
    return np.frombuffer(data, dtype, math.prod(shape), start).reshape(shape)


def _parse_npy(path: Path, data: bytes) -> np.ndarray:
    """The array of a ``.npy`` file's bytes."""
    if not data.startswith(npy_format.MAGIC_PREFIX):
        refuse(path, "a NumPy array", beginning(data))
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        shape, fortran, dtype = _NPY_HEADERS[version](stream)
    except ARRAY_FAILURES as error:
        refuse(path, "the header of a NumPy array", told(error))
    if dtype.hasobject:
        refuse(path, "real numbers", "Python objects")
    count, start = math.prod(shape), stream.tell()
    if min(shape, default=0) < 0 or count * dtype.itemsize != len(data) - start:
        refuse(path, f"the bytes of {shape} values of {dtype}", f"{len(data) - start} bytes")
    if not count:
        refuse(path, "height x width values", "x".join(map(str, shape)))
    array = np.frombuffer(data, dtype, count, start)
    return array.reshape(shape, order="F" if fortran else "C")


def _as_map(path: Path, array: np.ndarray) -> np.ndarray:
    """The map without an axis of length 1 before [1, H, W] or after [H, W, 1]; checked."""
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    check_stored(path, array.shape, array.dtype)
    return array


def _wanted(path: Path, names: set[str]) -> str:
    """The name of the map among an archive's arrays."""
    wanted = [key for key in _NPZ_KEYS if key in names] or sorted(names)
    if not wanted or (wanted[0] not in _NPZ_KEYS and len(names) > 1):
        refuse(path, "one array, or one named depth", ", ".join(sorted(names)[:5]) or "none")
    return wanted[0]


def _member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """A ``.npy`` file in an archive, refused if it claims to be absurdly larger than stored."""
    info = archive.getinfo(f"{name}.npy")
    most = max(_SMALL, _MOST_INFLATED * info.compress_size)
    if info.file_size > min(most, 8 * MAX_PIXELS):
        sizes = f"{info.compress_size:,} bytes that would become {info.file_size:,}"
        refuse(path, "no more values than an archive of its size holds", sizes)
    return archive.read(info)


def _kind_of(path: Path, data: bytes | None) -> DepthKind | None:
    if data is None:
        return None
    stored = _parse_npy(path, data)
    kind = str(stored.reshape(-1)[0])
    if stored.dtype.kind != "U" or kind not in KINDS:
        refuse(path, f"a kind of {', '.join(KINDS)}", repr(kind))
    return kind
