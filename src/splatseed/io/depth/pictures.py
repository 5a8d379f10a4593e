"""Depth maps stored as pictures: PNG and TIFF through Pillow, OpenEXR through its package.

Notation: as in ``arrays``, a stored map is H x W numbers in the file's own units. Promise:
only one-channel pictures count as depth, never the first channel of a colour picture; a damaged
file is a ``SceneFormatError`` that names it.
"""

from __future__ import annotations

import importlib
import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.io.depth.arrays import StoredDepth, check_stored, refuse
from splatseed.io.files import read_bytes
from splatseed.literal import told
from splatseed.requirements import require

_PILLOW_FAILURES = (
    *(OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, EOFError),
    *(OverflowError, AttributeError, struct.error, MemoryError),
)
_GREY = {"L", "I", "F", "I;16", "I;16B", "I;16L", "I;16N"}
_EXR_FAILURES = (RuntimeError, OSError, ValueError, TypeError, KeyError)
_EXR_CHANNELS = ("Z", "depth", "Depth", "D", "Y", "V", "R")
"""Where renderers put depth, first match first; R only if it is grey, without G and B beside it."""


def read_picture(path: Path) -> StoredDepth:
    """Read a PNG of 8 or 16 bits, or a TIFF of 8, 16 or 32 bits or floats.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no picture, is damaged, or has colours.
    """
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    data = read_bytes(path)
    try:
        with PilImage.open(io.BytesIO(data), formats=("PNG", "TIFF")) as picture:
            mode, is_png = picture.mode, picture.format == "PNG"
            values = np.asarray(picture) if mode in _GREY else None
    except (*_PILLOW_FAILURES, PilImage.DecompressionBombError) as error:
        refuse(path, "a readable PNG or TIFF", told(error))
    if values is None:
        refuse(path, "one channel of 8, 16 or 32 bits", f"a picture of mode {mode}")
    if is_png and values.dtype == np.int32:  # how some versions of Pillow open 16 bits
        values = values.astype(np.uint16)
    check_stored(path, values.shape, values.dtype)
    return StoredDepth(values)


def read_exr(path: Path) -> StoredDepth:
    """Read an OpenEXR picture: its channel Z, else depth, D, Y, V or R, else the only one.

    Raises:
        MissingDependencyError: The package OpenEXR is absent.
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no such picture, is damaged, or has no channel to take for depth.
    """
    require("OpenEXR")
    openexr = importlib.import_module("OpenEXR")
    read_bytes(path)  # check that it can be read; the package's own message says little
    try:
        with openexr.File(str(path), header_only=True) as file:
            _check_windows(path, file.header())
        with openexr.File(str(path), separate_channels=True) as file:
            values = _channel(path, {key: each.pixels for key, each in file.channels().items()})
    except (*_EXR_FAILURES, MemoryError) as error:
        refuse(path, "a readable OpenEXR picture", told(error))
    check_stored(path, values.shape, values.dtype)
    return StoredDepth(values)


def _channel(path: Path, channels: Mapping[str, np.ndarray]) -> np.ndarray:
    """The channel that holds depth; layers ("ViewLayer.Depth.Z") are known by their last word."""
    by_word = {name.rpartition(".")[2]: pixels for name, pixels in sorted(channels.items())}
    for word in _EXR_CHANNELS:
        if word in by_word:
            return by_word[word]
    if len(channels) != 1:
        refuse(path, f"a channel {', '.join(_EXR_CHANNELS)}", ", ".join(sorted(channels)) or "none")
    return next(iter(channels.values()))


def _check_windows(path: Path, header: Mapping[str, Any]) -> None:
    """Check, before decoding, that every pixel is stored and their number can be believed."""
    data, display = np.array(header["dataWindow"]), np.array(header["displayWindow"])
    size = (data[1] - data[0] + 1)[::-1].tolist()
    check_stored(path, tuple(size), np.dtype(np.float32))
    if not np.array_equal(data, display):
        refuse(path, f"the pixels of all of its picture {display.tolist()}", f"{data.tolist()}")
