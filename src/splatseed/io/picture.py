"""Open pictures with Pillow, with size and pixels as stored, of 8 or 16 bits per channel.

Pillow turns the pixels of TIFF files, and of no others, by their orientation when it decodes them.
COLMAP does not, so that the photographs would not fit their poses.

Raw converters and machine-vision cameras store 10, 12 or 14 bits in 16-bit files, which look nearly
black. All photographs of a capture are scaled alike, to keep exposures comparable: *white* is the
largest value of the bit depth that any of them uses.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import UInt16
from PIL import Image as PilImage
from PIL.ImageFile import ImageFile
from PIL.TiffImagePlugin import IMAGELENGTH, IMAGEWIDTH, TiffImageFile

from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.io.files import open_file, read_bytes, translate_errors
from splatseed.text import counted

ORIENTATION = 0x0112
"""EXIF's tag, and TIFF's."""
UPRIGHT = 1
WHITE = 65535
"""White if all 16 bits are used."""
_BITS = (8, 10, 12, 14)
"""Smaller bit depths of cameras and converters."""
_OTHER = "B" if sys.byteorder == "little" else "L"  # byte order than this machine's
_LOW_BYTES = {
    "LA;16B": "RGBA",  # both bytes of grey, then of alpha, as four channels
    **{
        f"{mode};16{order}": f"{mode};16{swapped}"
        for mode in ("RGB", "RGBA")
        for order, swapped in (("B", "L"), ("L", "B"), ("N", _OTHER))
    },
}
"""Pillow unpacks only the upper byte of 16-bit colours; the other byte order gives the lower."""
_EIGHT_BITS = frozenset({".jpg", ".jpeg", ".bmp", ".webp"})  # formats without 16 bits
_AT_ONCE = 4  # photographs decoded in parallel


def open_picture(file: IO[bytes] | Path, formats: tuple[str, ...] | None = None) -> ImageFile:
    """Open a picture of one of some formats (None: any); only its header is decoded."""
    picture = PilImage.open(file, formats=formats)
    if isinstance(picture, TiffImageFile) and picture.getexif().get(ORIENTATION) is not None:
        picture.getexif()[ORIENTATION] = UPRIGHT  # by which Pillow turns the pixels
        # Pillow has no public way to set the size, which it has swapped (test_picture.py).
        stored: Any = picture
        stored._size = (stored.tag_v2[IMAGEWIDTH], stored.tag_v2[IMAGELENGTH])  # noqa: SLF001
    return picture


def is_16_bit(photograph: PilImage.Image) -> bool:
    """Whether an opened image has 16 bits per channel."""
    grey = photograph.mode == "I" and photograph.format == "PNG"  # Pillow before version 11
    return grey or photograph.mode.startswith("I;16") or _layout(photograph) in _LOW_BYTES


def _layout(photograph: PilImage.Image) -> str:
    """Return Pillow's raw mode of the file."""
    tiles: list[Any] = getattr(photograph, "tile", None) or [None]
    if tiles[0] is None:
        return ""
    arguments = tiles[0][3]
    first = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return first if isinstance(first, str) else ""


def read_16_bit(encoded: bytes) -> UInt16[np.ndarray, "H W C"]:
    """Decode a 16-bit image; C is 1 (grey), 2 (grey, alpha), 3 or 4."""
    picture = open_picture(BytesIO(encoded))
    layout = _layout(picture)
    if layout not in _LOW_BYTES:
        return np.asarray(picture).astype(np.uint16)[..., None]
    high = np.asarray(picture)
    picture = open_picture(BytesIO(encoded))
    picture.tile = [_as_layout(tile, _LOW_BYTES[layout]) for tile in picture.tile]
    low = np.asarray(picture).astype(np.uint16)
    if layout.startswith("LA"):
        return np.stack([low[..., 0] << 8 | low[..., 1], low[..., 2] << 8 | low[..., 3]], axis=-1)
    return high.astype(np.uint16) << 8 | low


def _as_layout(tile: Any, layout: str) -> Any:
    codec, extents, offset, arguments = tile
    changed = (layout, *arguments[1:]) if isinstance(arguments, tuple) else layout
    parts = (codec, extents, offset, changed)
    return tile._replace(args=changed) if hasattr(tile, "_replace") else parts


def white_of(largest: int) -> int:
    """Return the largest value of the smallest bit depth that contains ``largest``."""
    return next((2**bits - 1 for bits in _BITS if 0 < largest < 2**bits), WHITE)


def opaque_value(alpha: UInt16[np.ndarray, "H W"]) -> int:
    """Return the value of opaque pixels in a 16-bit alpha channel."""
    return white_of(int(alpha.max(initial=0)))


def find_white(paths: Sequence[Path]) -> tuple[int, list[Finding]]:
    """Find the white of a capture, and report if its photographs use fewer than 16 bits.

    8-bit and unreadable files are ignored.
    """
    wide = [
        path for path in paths if path.suffix.lower() not in _EIGHT_BITS and _is_16_bit_file(path)
    ]
    largest = 0
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for first in range(0, len(wide), _AT_ONCE):
            largest = max(largest, *pool.map(_largest, wide[first : first + _AT_ONCE]))
            if white_of(largest) == WHITE and largest:  # usually known after the first few
                return WHITE, []
    white = white_of(largest)
    if white == WHITE:
        return WHITE, []
    bits = (white + 1).bit_length() - 1
    subject = f"{counted(len(wide), 'photograph')} of 16 bits per channel only use {bits}"
    values = f"(values up to {largest:,})"
    text = f"{subject} {values}: all are scaled alike, with {white:,} as white."
    return white, [Finding("few-bits", text, "info")]


def _is_16_bit_file(path: Path) -> bool:
    try:
        with translate_errors(path, "an image"), open_file(path) as file:
            return is_16_bit(PilImage.open(file))
    except SplatseedError:
        return False


def _largest(path: Path) -> int:
    """Return the largest colour value of a photograph; 0 if unreadable."""
    try:
        with translate_errors(path, "an image"):
            values = read_16_bit(read_bytes(path))
    except SplatseedError:
        return 0
    return int(values[..., : values.shape[-1] - (values.shape[-1] in {2, 4})].max(initial=0))
