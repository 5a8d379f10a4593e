"""Read depth files: NumPy, ``.pfm``, COLMAP's ``.bin``, PNG, TIFF and OpenEXR.

A stored map is H x W real numbers, top row first, in the file's own units. Headers are checked
against the bytes that follow before memory is allocated; pickles are not loaded; pictures must have
one channel.
"""

from __future__ import annotations

import importlib
import io
import math
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import UInt8

from splatseed.depthmap import DepthKind
from splatseed.io.files import StrPath, read_bytes, read_npy, translate_errors
from splatseed.io.picture import open_picture
from splatseed.requirements import require
from splatseed.text import beginning

KINDS: tuple[DepthKind, ...] = get_args(DepthKind)

_MAX_PIXELS = 2**28
"""Largest plausible map; larger headers are damaged or hostile."""
_MAX_INFLATION = 100
"""Largest compression factor of a map in an archive: measured values hardly compress."""
_SMALL = 1 << 26
"""Bytes up to which any compression factor is accepted: a map can be constant."""
_MAX_LEVEL = 2
"""The highest of ARKit's levels of confidence."""
_NPZ_KEYS = ("depth", "arr_0")
_PFM_HEADER = re.compile(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,32})[ \t]*\r?\n")
_BIN_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&1&")
_GREY = {"L", "I", "F", "I;16", "I;16B", "I;16L", "I;16N"}
_EXR_CHANNELS = ("Z", "depth", "Depth", "D", "Y", "V", "R")
"""Channels in which renderers store depth, in order of preference."""


def read_stored(path: StrPath) -> np.ndarray:
    """Read a depth map; the suffix, one of ``SUFFIXES``, determines the format.

    ``.npy``: an array [H, W], or with an axis of length 1 before or after. ``.npz``: the array
    ``depth``, else ``arr_0``, else the only one. ``.pfm``: one channel (Debevec's format; rows are
    kept bottom first; the sign of the scale is the byte order, its size is not used). ``.bin``:
    COLMAP's ``W&H&1&``, then float32 rows (mvs/mat.h). PNG of 8 or 16 bits, TIFF of 8, 16 or 32
    bits or floats. OpenEXR: the channel Z, else depth, D, Y, V or R, else the only one.
    """
    path = Path(path)
    data = read_bytes(path)
    with translate_errors(path, "a depth map"):
        suffix = path.suffix.lower()
        values = _READERS[suffix](path, data)
        if suffix in {".npy", ".npz"} and values.ndim == 3:  # [1, H, W] or [H, W, 1]
            short = next((axis for axis in (0, 2) if values.shape[axis] == 1), None)
            values = values if short is None else values.squeeze(short)
        check_stored(values.shape, values.dtype)
        return values


def read_confidence(path: StrPath) -> UInt8[np.ndarray, "H W"]:
    """Read the confidence of a depth map, 0 low, 1 medium, 2 high, from a PNG of 8 bits.

    Stored are these levels, as in ARKit's ``ARConfidenceLevel``, or 0, 127 and 255 (Polycam).
    """
    path = Path(path)
    data = read_bytes(path)
    with translate_errors(path, "a confidence map"):
        values = _read_picture(path, data)
        check_stored(values.shape, values.dtype)
        if values.dtype != np.uint8:
            raise ValueError(f"values of {values.dtype}, not 8 bits")
    levels = np.rint(values / 127.5) if values.max() > _MAX_LEVEL else values
    return np.asarray(levels, np.uint8)


def check_stored(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Raise ``ValueError`` unless an array is a depth map: two axes, not empty, real numbers."""
    if len(shape) != 2 or not 0 < math.prod(shape) <= _MAX_PIXELS or dtype.kind not in "uif":
        size = "x".join(map(str, shape)) or "one number"
        raise ValueError(f"{size} of {dtype}, not height x width real numbers")


def _read_npz(_: Path, data: bytes) -> np.ndarray:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:

        def member(name: str) -> np.ndarray:
            info = archive.getinfo(f"{name}.npy")
            packed, size = info.compress_size, info.file_size
            if size > min(max(_SMALL, _MAX_INFLATION * packed), 8 * _MAX_PIXELS):
                raise ValueError(f"{packed:,} bytes that expand to {size:,}")
            with archive.open(info) as file:
                return read_npy(file, size)

        names = (name for name in archive.namelist() if name.endswith(".npy"))
        arrays = sorted({name.removesuffix(".npy") for name in names})
        wanted = [key for key in _NPZ_KEYS if key in arrays] or arrays
        if not wanted or (wanted[0] not in _NPZ_KEYS and len(arrays) > 1):
            raise ValueError(f"arrays {', '.join(arrays[:5])}: several, and none named depth")
        return member(wanted[0])


def _read_pfm(_: Path, data: bytes) -> np.ndarray:
    header = _PFM_HEADER.match(data)
    scale = float(header[3]) if header else 0.0
    if header is None or not (math.isfinite(scale) and scale):
        raise ValueError(f"no one-channel float map (Pf), but {beginning(data)}")
    return _body(data, header, "<f4" if scale < 0 else ">f4")[::-1]


def _read_colmap(_: Path, data: bytes) -> np.ndarray:
    header = _BIN_HEADER.match(data)
    if header is None:
        raise ValueError(f"no depth map of COLMAP's (W&H&1&), but {beginning(data)}")
    return _body(data, header, "<f4")


def _body(data: bytes, header: re.Match[bytes], dtype: str) -> np.ndarray:
    """Return the values after a header with width and height, as a view."""
    shape, body = (int(header[2]), int(header[1])), memoryview(data)[header.end() :]
    check_stored(shape, np.dtype(dtype))
    if len(body) != math.prod(shape) * np.dtype(dtype).itemsize:
        raise ValueError(f"{len(body)} bytes for {shape[1]} x {shape[0]} values")
    return np.frombuffer(body, dtype).reshape(shape)


def _read_picture(_: Path, data: bytes) -> np.ndarray:
    with open_picture(io.BytesIO(data), ("PNG", "TIFF")) as picture:
        if picture.mode not in _GREY:
            raise ValueError(f"a picture of mode {picture.mode}, not one channel")
        values = np.asarray(picture)
        if picture.format == "PNG" and values.dtype == np.int32:
            values = values.astype(np.uint16)  # some versions of Pillow open 16 bits so
    return values


def _read_exr(path: Path, _: bytes) -> np.ndarray:
    require("OpenEXR")
    openexr = importlib.import_module("OpenEXR")
    with openexr.File(str(path), header_only=True) as file:
        # Check before decoding that every pixel is stored and their number is plausible.
        header: Mapping[str, Any] = file.header()
        data, display = np.array(header["dataWindow"]), np.array(header["displayWindow"])
        check_stored(tuple((data[1] - data[0] + 1)[::-1].tolist()), np.dtype(np.float32))
        if not np.array_equal(data, display):
            raise ValueError(f"pixels {data.tolist()} of a picture {display.tolist()}")
    with openexr.File(str(path), separate_channels=True) as file:
        channels = {name: each.pixels for name, each in sorted(file.channels().items())}
    # Match layers ("ViewLayer.Depth.Z") by the last part.
    by_part = {name.rpartition(".")[2]: pixels for name, pixels in channels.items()}
    found = next((part for part in _EXR_CHANNELS if part in by_part), None)
    if found is None and len(channels) != 1:
        raise ValueError(f"channels {', '.join(channels)}, none of {', '.join(_EXR_CHANNELS)}")
    return by_part[found] if found else next(iter(channels.values()))


_READERS: dict[str, Callable[[Path, bytes], np.ndarray]] = {
    ".npy": lambda _, data: read_npy(io.BytesIO(data), len(data)),
    ".npz": _read_npz,
    ".exr": _read_exr,
    ".pfm": _read_pfm,
    ".bin": _read_colmap,
    ".tiff": _read_picture,
    ".tif": _read_picture,
    ".png": _read_picture,
}
SUFFIXES = tuple(_READERS)
"""Suffixes of depth files, in order of preference: a PNG beside another file is its preview."""
