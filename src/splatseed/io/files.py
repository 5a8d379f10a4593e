"""Opening files that a scene names, which may be anything, and walking binary ones.

Promise: only regular files are opened, so that nothing blocks or reads forever (a pipe,
``/dev/zero``), and none larger than the free memory is read whole; a count in a file is checked
against the bytes that are left before anything is allocated for it. ``open_file``, ``read_file``
and ``read_text`` raise an ``OSError``; all else one of our errors, which names the file.
"""

from __future__ import annotations

import errno
import json
import lzma
import math
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format

from splatseed.errors import SceneFormatError, SceneNotFoundError, SplatseedError
from splatseed.runtime.memory import free_memory
from splatseed.text import beginning, describe_error

StrPath = str | os.PathLike[str]
"""A path, as functions that read or write files take it."""

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".3gp"})
COPY_AGAIN = "Copy the file again, or export it again."
ARCHIVE_FAILURES = (
    *(ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError, SyntaxError),
    *(EOFError, RecursionError, OSError, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
    struct.error,
    tokenize.TokenError,  # of headers that look like Python 2's: NumPy parses them as Python
    RuntimeError,  # encrypted, or compressed in a way that zipfile does not know
)
"""What a damaged ``.npy``, ``.npz`` or ``.zip`` can raise."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe, not a file",
    stat.S_IFSOCK: "a socket, not a file",
}
_WAIT_NOT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
_COUNT = struct.Struct("<Q")


def files_below(folder: Path) -> list[Path]:
    """The files in a folder and its subfolders, linked ones too, sorted."""
    found = list[Path]()
    for place, folders, names in os.walk(folder, followlinks=True):
        if os.path.realpath(place) in map(os.path.realpath, Path(place).parents):
            folders.clear()  # a link that leads back
        else:
            found += [Path(place, name) for name in names]
    return sorted(found)


def is_video(path: Path) -> bool:
    """Whether a path is a video file, by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def similar_name(path: Path) -> str | None:
    """The name of a file beside a missing one that differs in its suffix or in case only."""
    near: list[str] = []
    with suppress(OSError):
        near = sorted(each.name for each in path.parent.iterdir() if each.name != path.name)
    alike = [name for name in near if Path(name).stem.casefold() == path.stem.casefold()]
    return min(alike, key=lambda name: name.casefold() != path.name.casefold(), default=None)


def special_kind(path: Path) -> str:
    """What a path is that is neither a regular file nor a folder; empty if it is, or is nothing."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        return "a link that leads back to itself" if error.errno == errno.ELOOP else ""
    except ValueError:  # a NUL, or half a character
        return "a name that no file can have"
    return "" if stat.S_ISREG(mode) or stat.S_ISDIR(mode) else _kind(mode)


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading; an ``OSError`` for anything else."""
    _check(path, path.stat())  # opening alone can act on a device
    file = os.fdopen(os.open(path, os.O_RDONLY | _WAIT_NOT), "rb")
    try:
        _check(path, os.fstat(file.fileno()))  # it may have been replaced meanwhile
    except OSError:
        file.close()
        raise
    return file


def read_file(path: Path) -> bytes:
    """The whole content of a regular file; an ``OSError`` also if it exceeds the free memory."""
    with open_file(path) as file:
        check_fits_memory(path, os.fstat(file.fileno()).st_size)
        return file.read()


def check_fits_memory(path: Path, size: int) -> None:
    """Raise an ``OSError`` for a file whose content takes more bytes than are free."""
    free = free_memory()
    if free is not None and size > free:
        told = f"{size / 1e9:,.1f} GB, more than the {free / 1e9:,.1f} GB of free memory"
        raise OSError(errno.EFBIG, told, str(path))


def read_text(path: Path) -> str:
    """The whole content of a regular file of UTF-8, such as JSON or TOML, as ``read_file``."""
    return read_file(path).decode("utf-8")


def read_bytes(path: Path) -> bytes:
    """The whole content of a regular file; errors as ``translate_read_errors``'s."""
    with translate_read_errors(path):
        return read_file(path)


@contextmanager
def translate_read_errors(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` from reading a file into one of our errors.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read (a folder, no permission, a failing disk).
    """
    try:
        yield
    except SplatseedError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise SceneNotFoundError(f"a file at {path}", found="none", fix="Check the path.") from None
    except OSError as error:
        raise SceneFormatError(
            f"{path} to be a readable file",
            found=error.strerror or type(error).__name__,
            fix="Check that it is a file and that you may read it.",
        ) from None


@contextmanager
def translate_errors(path: Path, expected: str, *, fix: str = COPY_AGAIN) -> Iterator[None]:
    """Turn whatever reading a bad file raises, in a package or here, into a ``SceneFormatError``.

    It says that the file at ``path`` should be what is ``expected``.
    """
    try:
        yield
    except SplatseedError:
        raise
    except MemoryError:
        found = "more than memory holds"
    except BaseException as error:
        # Packages raise errors of many kinds; a panic of Rust is no Exception, as Ctrl-C is none.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        found = describe_error(error)  # type: ignore[arg-type]  # a panic has words, too
    else:
        return
    raise SceneFormatError(f"{path} to be {expected}", found=found, fix=fix)


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether column by column, and type of the array at the start of a ``.npy``."""
    magic = file.read(npy_format.MAGIC_LEN)
    if not magic.startswith(npy_format.MAGIC_PREFIX):
        raise ValueError(f"no NumPy array, but {beginning(magic)}")
    if magic.endswith(b"\x01\x00"):
        return npy_format.read_array_header_1_0(file)
    return npy_format.read_array_header_2_0(file)


def read_npy(file: IO[bytes], most: float = np.inf) -> np.ndarray:
    """The array of a ``.npy``; ``ValueError`` for one of objects or of more than ``most`` bytes."""
    shape, turned, dtype = read_npy_header(file)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=0) < 0 or size > most:
        raise ValueError(f"{shape} values of {dtype} in {most:,.0f} bytes")
    data = file.read(size + 1)
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes for {shape} values of {dtype}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if turned else "C")


def numbered_lines(path: Path) -> Iterator[tuple[str, str]]:
    """The lines of a UTF-8 file with their places, its byte order mark left out."""
    raw = read_bytes(path)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        number = raw.count(b"\n", 0, error.start) + 1
        found = repr(raw[error.start : error.end])
        raise SceneFormatError(
            f"UTF-8 text in {path}, line {number}", found=found, fix=COPY_AGAIN
        ) from None
    for number, line in enumerate(text.split("\n"), start=1):
        yield f"{path}, line {number}", line


def read_json(path: Path, expected: str = "JSON", *, fix: str = COPY_AGAIN) -> Any:
    """Parse a JSON file; raises as ``read_bytes``, and SceneFormatError if it is not JSON."""
    data = read_bytes(path)
    with translate_errors(path, expected, fix=fix):
        if not data.strip():
            raise ValueError("an empty file")
        return json.loads(data)


class ByteReader:
    """Reads a little-endian binary file, whole in memory, from front to back.

    What ends early, or cannot be, is a ``SceneFormatError`` that names file, byte and ``record``.
    """

    def __init__(self, path: Path, fix: str = COPY_AGAIN) -> None:
        self.path, self.fix, self.data = path, fix, read_bytes(path)
        self.offset, self.record = 0, "header"

    @property
    def remaining(self) -> int:
        """Bytes not read yet."""
        return len(self.data) - self.offset

    @property
    def where(self) -> str:
        """The current place, for errors."""
        return f"{self.path}, {self.record}, byte {self.offset}"

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The values of a fixed layout."""
        return layout.unpack(self._take(layout.size))

    def array(self, dtype: np.dtype[Any], count: int) -> np.ndarray:
        """The next ``count`` items, a read-only view of the file's bytes."""
        return np.frombuffer(self._take(count * dtype.itemsize), dtype)

    def count(self, least_bytes: int, what: str) -> int:
        """A u64 count of items that take at least ``least_bytes`` each, checked to fit."""
        (count,) = self.unpack(_COUNT)
        room = self.remaining // least_bytes
        if count > room:
            raise self.error(f"at most {room} {what} in the bytes that follow", f"{count} promised")
        return int(count)

    def records(self, least_bytes: int, what: str) -> Iterator[str]:
        """The place of each of as many records as a count promises, which end the file."""
        count = self.count(least_bytes, what)
        for idx in range(count):
            self.record = f"record {idx + 1} of {count}"
            yield self.where
        self.finish()

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

    def error(self, expected: str, found: str) -> SceneFormatError:
        """An error at the current place."""
        return SceneFormatError(f"{expected} in {self.where}", found=found, fix=self.fix)

    def _take(self, size: int) -> memoryview:
        if size > self.remaining:
            raise self.error(f"{size} more bytes", f"{self.remaining} before the end of the file")
        self.offset += size
        return memoryview(self.data)[self.offset - size : self.offset]


def _check(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, _kind(status.st_mode), str(path))


def _kind(mode: int) -> str:
    return _KINDS.get(stat.S_IFMT(mode), "a device, not a file")
