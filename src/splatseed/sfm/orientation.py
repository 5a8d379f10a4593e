"""Orientation: the EXIF tag that says how to rotate a photograph.

COLMAP reads pixels as they are stored and keeps the tag in what it writes. A trainer whose image
reader obeys the tag (as OpenCV's does) would then see the photograph rotated relative to its
camera. Promise: ``clear_orientation`` changes the tag's two bytes and nothing else.
"""

from __future__ import annotations

import struct
from pathlib import Path

from PIL import Image as PilImage

_TAG = 0x0112
_UPRIGHT = 1
_EXIF = b"Exif\0\0"
_HEAD_BYTES = 1 << 17  # the EXIF segment, at most 64 KiB, comes first or after a small one


def clear_orientation(folder: Path) -> None:
    """Mark every JPEG below ``folder`` as upright in its stored orientation."""
    for path in folder.rglob("*"):
        if path.suffix.lower() in {".jpg", ".jpeg"} and _is_turned(path):
            content = bytearray(path.read_bytes())
            at = _find_orientation(bytes(content[:_HEAD_BYTES]))
            if at is not None:
                offset, order = at
                struct.pack_into(f"{order}H", content, offset, _UPRIGHT)
                path.unlink()  # a copy of a read-only photograph is read-only
                path.write_bytes(content)


def _is_turned(path: Path) -> bool:
    with PilImage.open(path) as image:
        return bool(image.getexif().get(_TAG, _UPRIGHT) != _UPRIGHT)


def _find_orientation(head: bytes) -> tuple[int, str] | None:
    """The position of the tag's value, and its byte order ('<' or '>').

    EXIF is a TIFF file in an APP1 segment (CIPA DC-008, 4.5): byte order, offset of the first
    directory, its number of entries, then 12 bytes an entry: tag, type, count, value.
    """
    tiff = head.find(_EXIF) + len(_EXIF)
    order = {b"II": "<", b"MM": ">"}.get(head[tiff : tiff + 2])
    if order is None:
        return None
    try:
        directory = tiff + struct.unpack_from(f"{order}I", head, tiff + 4)[0]
        (entries,) = struct.unpack_from(f"{order}H", head, directory)
        for entry in range(directory + 2, directory + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", head, entry)[0] == _TAG:
                return entry + 8, order
    except struct.error:  # an offset beyond the segment
        return None
    return None
