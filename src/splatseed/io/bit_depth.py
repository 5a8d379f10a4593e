"""Photographs of 16 bits a channel: their values, and how many of the bits a capture uses.

Raw converters and machine-vision cameras store 10, 12 or 14 bits in files of 16. Shown as they are,
these are nearly black. All photographs of a capture are stretched alike, so that exposures stay
comparable: *white* is the largest value of as many bits as any of them uses.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import open_file, read_bytes, translate_errors
from splatseed.text import counted

WHITE = 65535
"""White where all 16 bits are used."""
_BITS = (8, 10, 12, 14)
"""Other depths that cameras and converters have."""
_NATIVE, _OTHER = ("L", "B") if sys.byteorder == "little" else ("B", "L")
_LOW_BYTES = {
    "LA;16B": "RGBA",  # both bytes of grey, then of alpha, as four channels
    **{
        f"{mode};16{order}": f"{mode};16{swapped}"
        for mode in ("RGB", "RGBA")
        for order, swapped in (("B", "L"), ("L", "B"), ("N", _OTHER))
    },
}
"""Pillow unpacks the upper byte of 16-bit colours; in the other byte order that is the lower."""
_EIGHT_BITS = frozenset({".jpg", ".jpeg", ".bmp", ".webp"})  # formats without 16 bits
_AT_ONCE = 4  # photographs that are decoded at a time


def is_16_bit(photograph: PilImage.Image) -> bool:
    """Whether an opened image has 16 bits a channel."""
    grey = photograph.mode == "I" and photograph.format == "PNG"  # Pillow before version 11
    return grey or photograph.mode.startswith("I;16") or _layout(photograph) in _LOW_BYTES


def _layout(photograph: PilImage.Image) -> str:
    """How the file stores pixels, in Pillow's terms."""
    tiles: list[Any] = getattr(photograph, "tile", None) or [None]
    if tiles[0] is None:
        return ""
    arguments = tiles[0][3]
    first = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return first if isinstance(first, str) else ""


def read_16_bit(encoded: bytes) -> UInt16[np.ndarray, "H W C"]:
    """The values of an image that ``is_16_bit``; C = 1 (grey), 2 (grey, alpha), 3 or 4."""
    picture = PilImage.open(BytesIO(encoded))
    layout = _layout(picture)
    if layout not in _LOW_BYTES:
        return np.asarray(picture).astype(np.uint16)[..., None]
    high = np.asarray(picture)
    picture = PilImage.open(BytesIO(encoded))
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
    """The largest value of the bits that hold ``largest``."""
    return next((2**bits - 1 for bits in _BITS if 0 < largest < 2**bits), WHITE)


def opaque_value(alpha: UInt16[np.ndarray, "H W"]) -> int:
    """The value of opaque pixels in a photograph's alpha channel of 16 bits."""
    return white_of(int(alpha.max(initial=0)))


def find_white(paths: Sequence[Path]) -> tuple[int, list[str]]:
    """White of a capture's photographs, and a note where they do not use all bits of 16.

    Files of 8 bits, and those that cannot be read, have no part in it.
    """
    wide = [
        path for path in paths if path.suffix.lower() not in _EIGHT_BITS and _is_16_bit_file(path)
    ]
    largest = 0
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for first in range(0, len(wide), _AT_ONCE):
            largest = max(largest, *pool.map(_largest, wide[first : first + _AT_ONCE]))
            if white_of(largest) == WHITE and largest:  # mostly known from the first few
                return WHITE, []
    white = white_of(largest)
    if white == WHITE:
        return WHITE, []
    bits = (white + 1).bit_length() - 1
    which = f"{counted(len(wide), 'photograph')} of 16 bits a channel only use {bits}"
    values = f"(values up to {largest:,})"
    return white, [f"{which} {values}: all are stretched alike, with {white:,} as white."]


def _is_16_bit_file(path: Path) -> bool:
    try:
        with translate_errors(path, "an image"), open_file(path) as file:
            return is_16_bit(PilImage.open(file))
    except (SceneFormatError, SceneNotFoundError):
        return False


def _largest(path: Path) -> int:
    """The largest value of a photograph's colours; 0 if it cannot be read."""
    try:
        with translate_errors(path, "an image"):
            values = read_16_bit(read_bytes(path))
    except (SceneFormatError, SceneNotFoundError):
        return 0
    return int(values[..., : values.shape[-1] - (values.shape[-1] in {2, 4})].max(initial=0))
