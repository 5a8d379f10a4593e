"""Depth maps as files store them: NumPy's, ``.pfm``, COLMAP's ``.bin``, PNG, TIFF and OpenEXR.

Notation: a stored map is H x W real numbers, top row first, still in the file's own units. Promise:
a header is checked against the bytes that follow before anything is allocated for it, no pickle is
loaded, only one-channel pictures count as depth, and every failure is a ``SceneFormatError`` that
names the file.
"""

from __future__ import annotations

import importlib
import io
import math
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from splatseed.depthmap import DepthKind
from splatseed.io.files import guarded, read_bytes, read_npy_header
from splatseed.literal import beginning
from splatseed.requirements import require

KINDS: tuple[DepthKind, ...] = get_args(DepthKind)

_MAX_PIXELS = 2**28
"""The largest plausible map: a header that promises more is damaged or hostile."""
_MOST_INFLATED = 100
"""How many times larger than in its archive a map can be: measured values hardly compress."""
_SMALL = 1 << 26
"""Maps of up to this many bytes are harmless at any compression: a map can be constant."""
_NPZ_KEYS = ("depth", "arr_0")
_PFM_HEADER = re.compile(rb"Pf\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,32})[ \t]*\r?\n")
_BIN_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&1&")
_GREY = {"L", "I", "F", "I;16", "I;16B", "I;16L", "I;16N"}
_EXR_CHANNELS = ("Z", "depth", "Depth", "D", "Y", "V", "R")
"""Where renderers put depth, first match first; R only if it is grey, without G and B beside it."""


class StoredDepth(NamedTuple):
    """A map as stored in its file.

    Args:
        values: Real numbers [H, W].
        kind: What the values are, if the file says so; else None.
    """

    values: np.ndarray
    kind: DepthKind | None = None


def read_stored(path: Path) -> StoredDepth:
    """Read a depth map; its suffix, one of ``SUFFIXES``, tells the format.

    ``.npy``: an array [H, W], or with an axis of length 1 before or after. ``.npz``: the array
    ``depth``, else ``arr_0``, else the only one; a text ``kind`` in it ("z", "ray" or "inverse")
    says what the values are. ``.pfm``: one channel (Debevec's format; rows are kept bottom first;
    the sign of the scale is the byte order, its size is not used). ``.bin``: COLMAP's ``W&H&1&``,
    then float32 rows (mvs/mat.h). PNG of 8 or 16 bits, TIFF of 8, 16 or 32 bits or floats.
    OpenEXR: the channel Z, else depth, D, Y, V or R, else the only one.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is damaged, or no map of real numbers.
        MissingDependencyError: It is an OpenEXR file, and that package is absent.
    """
    data = read_bytes(path)
    with guarded(path, "a depth map"):
        stored = _READERS[path.suffix.lower()](path, data)
        check_stored(stored.values.shape, stored.values.dtype)
        return stored


def check_stored(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    """Check that an array can be a depth map: not empty, not absurd, real numbers.

    Raises:
        ValueError: It cannot.
    """
    if len(shape) != 2 or not 0 < math.prod(shape) <= _MAX_PIXELS or dtype.kind not in "uif":
        size = "x".join(map(str, shape)) or "one number"
        raise ValueError(f"{size} of {dtype}, not height x width real numbers")


def _read_npy(_: Path, data: bytes) -> StoredDepth:
    return StoredDepth(_as_map(_parse_npy(data)))


def _read_npz(_: Path, data: bytes) -> StoredDepth:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = {n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy")}
        kind = str(_member(archive, "kind").reshape(-1)[0]) if "kind" in names else None
        if kind is not None and kind not in KINDS:
            raise ValueError(f"kind {kind!r}, not one of {', '.join(KINDS)}")
        arrays = sorted(names - {"kind"})
        wanted = [key for key in _NPZ_KEYS if key in arrays] or arrays
        if not wanted or (wanted[0] not in _NPZ_KEYS and len(arrays) > 1):
            raise ValueError(f"arrays {', '.join(arrays[:5])}: not one, and none named depth")
        return StoredDepth(_as_map(_member(archive, wanted[0])), kind)


def _read_pfm(_: Path, data: bytes) -> StoredDepth:
    header = _PFM_HEADER.match(data)
    scale = float(header[3]) if header else 0.0
    if header is None or not (math.isfinite(scale) and scale):
        raise ValueError(f"no one-channel float map (Pf), but {beginning(data)}")
    shape = (int(header[2]), int(header[1]))
    return StoredDepth(_body(data, header.end(), shape, "<f4" if scale < 0 else ">f4")[::-1])


def _read_colmap(_: Path, data: bytes) -> StoredDepth:
    header = _BIN_HEADER.match(data)
    if header is None:
        raise ValueError(f"no depth map of COLMAP's (W&H&1&), but {beginning(data)}")
    return StoredDepth(_body(data, header.end(), (int(header[2]), int(header[1])), "<f4"))


def _read_picture(_: Path, data: bytes) -> StoredDepth:
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    with PilImage.open(io.BytesIO(data), formats=("PNG", "TIFF")) as picture:
        if picture.mode not in _GREY:
            raise ValueError(f"a picture of mode {picture.mode}, not one channel")
        values = np.asarray(picture)
        if picture.format == "PNG" and values.dtype == np.int32:
            values = values.astype(np.uint16)  # how some versions of Pillow open 16 bits
    return StoredDepth(values)


def _read_exr(path: Path, _: bytes) -> StoredDepth:
    require("OpenEXR")
    openexr = importlib.import_module("OpenEXR")
    with openexr.File(str(path), header_only=True) as file:
        # Before decoding: every pixel is stored, and their number can be believed.
        header: Mapping[str, Any] = file.header()
        data, display = np.array(header["dataWindow"]), np.array(header["displayWindow"])
        check_stored(tuple((data[1] - data[0] + 1)[::-1].tolist()), np.dtype(np.float32))
        if not np.array_equal(data, display):
            raise ValueError(f"pixels {data.tolist()} of a picture {display.tolist()}")
    with openexr.File(str(path), separate_channels=True) as file:
        channels = {name: each.pixels for name, each in sorted(file.channels().items())}
    # Layers ("ViewLayer.Depth.Z") are known by their last word.
    by_word = {name.rpartition(".")[2]: pixels for name, pixels in channels.items()}
    found = next((word for word in _EXR_CHANNELS if word in by_word), None)
    if found is None and len(channels) != 1:
        raise ValueError(f"channels {', '.join(channels)}, none of {', '.join(_EXR_CHANNELS)}")
    return StoredDepth(by_word[found] if found else next(iter(channels.values())))


def _body(data: bytes, start: int, shape: tuple[int, int], dtype: str) -> np.ndarray:
    """The values that follow a header, a view of the file's bytes."""
    check_stored(shape, np.dtype(dtype))
    promised = math.prod(shape) * np.dtype(dtype).itemsize
    if len(data) - start != promised:
        raise ValueError(f"{len(data) - start} bytes for {shape[1]} x {shape[0]} values")
    return np.frombuffer(data, dtype, math.prod(shape), start).reshape(shape)


def _parse_npy(data: bytes) -> np.ndarray:
    """The array of a ``.npy`` file's bytes."""
    stream = io.BytesIO(data)
    shape, fortran, dtype = read_npy_header(stream)
    count, start = math.prod(shape), stream.tell()
    if dtype.hasobject or min(shape, default=0) < 0 or count * dtype.itemsize != len(data) - start:
        raise ValueError(f"{len(data) - start} bytes for {shape} values of {dtype}")
    array = np.frombuffer(data, dtype, count, start) if count else np.empty(0, dtype)
    return array.reshape(shape, order="F" if fortran else "C")


def _as_map(array: np.ndarray) -> np.ndarray:
    """The map without an axis of length 1 before [1, H, W] or after [H, W, 1]."""
    if array.ndim == 3 and 1 in (array.shape[0], array.shape[2]):
        return np.asarray(array[0] if array.shape[0] == 1 else array[..., 0])
    return array


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """An array in an archive, refused if it claims to be absurdly larger than stored."""
    info = archive.getinfo(f"{name}.npy")
    if info.file_size > min(max(_SMALL, _MOST_INFLATED * info.compress_size), 8 * _MAX_PIXELS):
        raise ValueError(f"{info.compress_size:,} bytes that would become {info.file_size:,}")
    return _parse_npy(archive.read(info))


_READERS: dict[str, Callable[[Path, bytes], StoredDepth]] = {
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".exr": _read_exr,
    ".pfm": _read_pfm,
    ".bin": _read_colmap,
    ".tiff": _read_picture,
    ".tif": _read_picture,
    ".png": _read_picture,
}
SUFFIXES = tuple(_READERS)
"""Suffixes of readable files. PNG comes last: beside a file of exact numbers it is their
picture."""
