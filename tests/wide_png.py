"""A writer of images that Pillow does not write."""

from __future__ import annotations

import struct
import zlib


def png16(channels, transparent=None):
    """A PNG of 16 bits of [H, W, C], as Pillow does not write them; C = 1, 2 (grey), 3 or 4."""
    height, width, count = channels.shape
    color = {1: 0, 2: 4, 3: 2, 4: 6}[count]
    header = struct.pack(">IIBBBBB", width, height, 16, color, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in channels)
    extra = [] if transparent is None else [(b"tRNS", struct.pack(">H", transparent))]
    chunks = [(b"IHDR", header), *extra, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
