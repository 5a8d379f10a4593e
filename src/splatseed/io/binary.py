"""A reader that walks a little-endian binary file and never trusts it.

Notation: ``offset`` is the next unread byte. Promise: a count is checked against the bytes that are
left before anything is allocated for it, and every failure is a ``SceneFormatError`` that names the
file, the record and the byte.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.io.files import read_bytes
from splatseed.literal import beginning

_COUNT = struct.Struct("<Q")


class ByteReader:
    """Reads a binary file from front to back.

    Args:
        path: The file; it is read whole.
        fix: What errors advise.

    Attributes:
        data: Its bytes.
        offset: The next byte to read.
        record: What is being read, for errors ("header", "record 3").

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read.
    """

    def __init__(self, path: Path, fix: str) -> None:
        self.path = path
        self.fix = fix
        self.data = read_bytes(path)
        self.offset = 0
        self.record = "header"

    @property
    def remaining(self) -> int:
        """Bytes not read yet."""
        return len(self.data) - self.offset

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The values of a fixed layout."""
        self._require(layout.size)
        values = layout.unpack_from(self.data, self.offset)
        self.offset += layout.size
        return values

    def count(self, least_bytes: int, what: str) -> int:
        """A u64 count of items that take at least ``least_bytes`` each, checked to fit."""
        (count,) = self.unpack(_COUNT)
        room = self.remaining // least_bytes
        if count > room:
            raise self.error(f"at most {room} {what} in the bytes that follow", f"{count} promised")
        return int(count)

    def array(self, dtype: np.dtype[Any], count: int) -> np.ndarray:
        """The next ``count`` items, a read-only view of the file's bytes."""
        self._require(count * dtype.itemsize)
        items = np.frombuffer(self.data, dtype, count, self.offset)
        self.offset += count * dtype.itemsize
        return items

    def text(self) -> str:
        """A NUL-terminated UTF-8 string."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.error("a name ended by a zero byte", "the end of the file")
        raw = self.data[self.offset : end]
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError:
            raise self.error("a name in UTF-8", beginning(raw, 80)) from None
        self.offset = end + 1
        return text

    def finish(self) -> None:
        """Check that no bytes are left."""
        if self.remaining:
            self.record = "end"
            raise self.error("the end of the file", f"{self.remaining} more bytes")

    @property
    def where(self) -> str:
        """The current place, for errors."""
        return f"{self.path}, {self.record}, byte {self.offset}"

    def error(self, expected: str, found: str) -> SceneFormatError:
        """An error at the current place."""
        return SceneFormatError(f"{expected} in {self.where}", found=found, fix=self.fix)

    def _require(self, size: int) -> None:
        if size > self.remaining:
            raise self.error(f"{size} more bytes", f"{self.remaining} before the end of the file")
