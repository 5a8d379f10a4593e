"""Safe reading of untrusted files: regular files only, bounded memory, parsing of binary records.

Pipes and devices, which could block or never end, are refused, as is reading a file larger than
the free memory. A count in a file is checked against the remaining bytes before memory is
allocated for it. ``open_file``, ``read_file`` and ``read_text`` raise ``OSError``; the other
functions raise ``SplatseedError`` with the file's name.
"""

from __future__ import annotations

import errno
import json
import lzma
import math
import os
import stat
import struct
import threading
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
"""A path argument of a function that reads or writes files."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
"""Of photographs; one that is named without a suffix is searched for in this order."""
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".3gp"})
COPY_AGAIN = "Copy the file again, or export it again."
ARCHIVE_FAILURES = (
    *(ValueError, TypeError, KeyError, IndexError, OverflowError, MemoryError, SyntaxError),
    *(EOFError, RecursionError, OSError, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
    struct.error,
    tokenize.TokenError,  # of headers that look like Python 2's: NumPy parses them as Python
    RuntimeError,  # encrypted, or compressed in a way that zipfile does not know
)
"""Exceptions from a damaged ``.npy``, ``.npz`` or ``.zip``."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe, not a file",
    stat.S_IFSOCK: "a socket, not a file",
}
_OPEN_FLAGS = (
    getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
)
_COUNT = struct.Struct("<Q")
_SMALL_FILE = 1 << 20
"""Bytes that always fit: to look up the free memory takes longer than to read them."""
_PARSER = threading.Lock()
"""NumPy parses headers as Python, which two threads at once fail at (python/cpython#106905)."""


def files_below(folder: Path) -> list[Path]:
    """List the files in a folder and its subfolders, sorted; links are followed.

    Hidden ones are left out, such as macOS's ``._a.png`` beside ``a.png`` on other file systems.
    """
    found = list[Path]()
    for place, folders, names in os.walk(folder, followlinks=True):
        if os.path.realpath(place) in map(os.path.realpath, Path(place).parents):
            folders.clear()  # a link to a parent
        else:
            folders[:] = [name for name in folders if not is_hidden(name)]
            found += [Path(place, name) for name in names if not is_hidden(name)]
    return sorted(found)


def image_names(folder: Path) -> list[str]:
    """Return the sorted names of the image files in a folder, hidden ones left out; [] without."""
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return sorted(n for n in names if Path(n).suffix.lower() in IMAGE_SUFFIXES and not is_hidden(n))


def absolute(path: Path) -> Path:
    """Return an absolute path without ``..``; links are not followed, so names are as in COLMAP."""
    return Path(os.path.abspath(path))  # noqa: PTH100  (resolve would follow links)


def is_hidden(name: str) -> bool:
    """Whether a file or folder of this name is hidden."""
    return name.startswith(".")


def is_video(path: Path) -> bool:
    """Whether a path is a file with a video suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def similar_name(path: Path) -> str | None:
    """Find a file in the same folder whose name differs in suffix or case only."""
    siblings: list[str] = []
    with suppress(OSError):
        siblings = sorted(p.name for p in path.parent.iterdir() if p.name != path.name)
    similar = [name for name in siblings if Path(name).stem.casefold() == path.stem.casefold()]
    return min(similar, key=lambda name: name.casefold() != path.name.casefold(), default=None)


def special_kind(path: Path) -> str:
    """Describe a path that is neither a file nor a folder (a pipe, a link loop); else return ""."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        return "a link that leads back to itself" if error.errno == errno.ELOOP else ""
    except ValueError:  # a NUL or a lone surrogate
        return "a name that no file can have"
    return "" if stat.S_ISREG(mode) or stat.S_ISDIR(mode) else _kind(mode)


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading; raise ``OSError`` for anything else."""
    _check_regular(path, path.stat())  # opening a device can already act on it
    file = os.fdopen(os.open(path, os.O_RDONLY | _OPEN_FLAGS), "rb")
    try:
        _check_regular(path, os.fstat(file.fileno()))  # it may have been replaced meanwhile
    except OSError:
        file.close()
        raise
    return file


def read_file(path: Path) -> bytes:
    """Read a regular file; raise ``OSError`` also if it does not fit in free memory."""
    with open_file(path) as file:
        check_fits_memory(path, os.fstat(file.fileno()).st_size)
        return file.read()


def check_fits_memory(path: Path, size: int) -> None:
    """Raise ``OSError`` if a file of ``size`` bytes does not fit in free memory."""
    free = None if size <= _SMALL_FILE else free_memory()
    if free is not None and size > free:
        reason = f"{size / 1e9:,.1f} GB, more than the {free / 1e9:,.1f} GB of free memory"
        raise OSError(errno.EFBIG, reason, str(path))


def read_text(path: Path) -> str:
    """Read a UTF-8 text file; raises as ``read_file``."""
    return read_file(path).decode("utf-8")


def read_bytes(path: Path) -> bytes:
    """Read a regular file; raises as ``translate_read_errors``."""
    with translate_read_errors(path):
        return read_file(path)


@contextmanager
def translate_read_errors(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` from reading a file into a ``SplatseedError``."""
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
    """Turn any exception from parsing a file into ``SceneFormatError``, "PATH to be EXPECTED"."""
    try:
        yield
    except SplatseedError:
        raise
    except MemoryError:
        found = "more than memory holds"
    except BaseException as error:
        # Libraries raise errors of many kinds. A Rust panic is a BaseException, as is Ctrl-C.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        found = describe_error(error)  # type: ignore[arg-type]  # a panic has a message
        if type(error).__name__ == "DecompressionBombError":  # Pillow is not imported for this
            fix = "Make a smaller copy in its place: Pillow opens no larger images."
    else:
        return
    raise SceneFormatError(f"{path} to be {expected}", found=found, fix=fix)


def read_npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of a ``.npy`` file: shape, whether in Fortran order, and dtype."""
    magic = file.read(npy_format.MAGIC_LEN)
    if not magic.startswith(npy_format.MAGIC_PREFIX):
        raise ValueError(f"no NumPy array, but {beginning(magic)}")
    with _PARSER:
        if magic.endswith(b"\x01\x00"):
            return npy_format.read_array_header_1_0(file)
        return npy_format.read_array_header_2_0(file)


def read_npy(file: IO[bytes], max_bytes: float = np.inf) -> np.ndarray:
    """Read a ``.npy`` file; raise ``ValueError`` for objects or more than ``max_bytes``."""
    shape, fortran_order, dtype = read_npy_header(file)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=0) < 0 or size > max_bytes:
        raise ValueError(f"{shape} values of {dtype} in {max_bytes:,.0f} bytes")
    data = file.read(size + 1)
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes for {shape} values of {dtype}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran_order else "C")


def numbered_lines(path: Path, errors: str = "strict") -> Iterator[tuple[str, str]]:
    """Yield "PATH, line N" and the text of each line of a UTF-8 file, without a byte order mark.

    ``errors`` is that of ``bytes.decode``.
    """
    raw = read_bytes(path)
    try:
        text = raw.decode("utf-8-sig", errors)
    except UnicodeDecodeError as error:
        number = raw.count(b"\n", 0, error.start) + 1
        found = repr(raw[error.start : error.end])
        raise SceneFormatError(
            f"UTF-8 text in {path}, line {number}", found=found, fix=COPY_AGAIN
        ) from None
    for number, line in enumerate(text.split("\n"), start=1):
        yield f"{path}, line {number}", line


def is_data(line: str) -> bool:
    """Whether a line of a text file is neither blank nor a comment."""
    stripped = line.lstrip()
    return bool(stripped) and not stripped.startswith("#")


def read_json(path: Path, expected: str = "JSON", *, fix: str = COPY_AGAIN) -> Any:
    """Parse a JSON file; raises as ``read_bytes``, and SceneFormatError if it is not JSON."""
    data = read_bytes(path)
    with translate_errors(path, expected, fix=fix):
        if not data.strip():
            raise ValueError("an empty file")
        return json.loads(data)


class ByteReader:
    """Parses a little-endian binary file in memory, front to back.

    Truncated or impossible data raises ``SceneFormatError`` with file, record and byte offset.
    """

    def __init__(self, path: Path, fix: str = COPY_AGAIN) -> None:
        self.path, self.fix, self.data = path, fix, read_bytes(path)
        self.offset, self.record = 0, "header"

    @property
    def remaining(self) -> int:
        """Number of unread bytes."""
        return len(self.data) - self.offset

    @property
    def where(self) -> str:
        """The current position, for error messages."""
        return f"{self.path}, {self.record}, byte {self.offset}"

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read one struct."""
        return layout.unpack(self._take(layout.size))

    def array(self, dtype: np.dtype[Any], count: int) -> np.ndarray:
        """Read ``count`` items as a read-only view of the file's bytes."""
        return np.frombuffer(self._take(count * dtype.itemsize), dtype)

    def count(self, min_bytes: int, noun: str) -> int:
        """Read a u64 count; check that as many items of ``min_bytes`` each fit in the file."""
        (count,) = self.unpack(_COUNT)
        limit = self.remaining // min_bytes
        if count > limit:
            expected = f"at most {limit} {noun} in the remaining bytes"
            raise self.error(expected, f"a count of {count}")
        return int(count)

    def records(self, min_bytes: int, noun: str) -> Iterator[str]:
        """Read a count, then yield the position of each record; the last must end the file."""
        count = self.count(min_bytes, noun)
        for idx in range(count):
            self.record = f"record {idx + 1} of {count}"
            yield self.where
        self.finish()

    def text(self) -> str:
        """Read a NUL-terminated UTF-8 string; other bytes become surrogates."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.error("a name ended by a zero byte", "the end of the file")
        text = self.data[self.offset : end].decode("utf-8", "surrogateescape")
        self.offset = end + 1
        return text

    def finish(self) -> None:
        """Raise unless all bytes were read."""
        if self.remaining:
            self.record = "end"
            raise self.error("the end of the file", f"{self.remaining} more bytes")

    def error(self, expected: str, found: str) -> SceneFormatError:
        """Make an error for the current position."""
        return SceneFormatError(f"{expected} in {self.where}", found=found, fix=self.fix)

    def _take(self, size: int) -> memoryview:
        if size > self.remaining:
            raise self.error(f"{size} more bytes", f"{self.remaining} before the end of the file")
        self.offset += size
        return memoryview(self.data)[self.offset - size : self.offset]


def _check_regular(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, _kind(status.st_mode), str(path))


def _kind(mode: int) -> str:
    return _KINDS.get(stat.S_IFMT(mode), "a device, not a file")
