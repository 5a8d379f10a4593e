"""Opening files that a scene names, which may be anything.

Promise: only regular files are opened, so that nothing blocks or reads forever (a pipe,
``/dev/zero``), and none larger than the free memory. What is refused raises an ``OSError`` whose
``strerror`` says why, just as the system's refusals do; ``read_bytes`` turns these into our errors.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.process.memory import free_memory

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".3gp"})

_KINDS = (
    (stat.S_ISDIR, errno.EISDIR, "a folder"),
    (stat.S_ISFIFO, errno.EINVAL, "a pipe, not a file"),
    (stat.S_ISSOCK, errno.EINVAL, "a socket, not a file"),
    (lambda _: True, errno.EINVAL, "a device, not a file"),
)
_WAIT_NOT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


def is_video(path: Path) -> bool:
    """Whether a path is a video file, by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def other_spelling(path: Path) -> str | None:
    """The name of a file beside a missing one that differs in its suffix or in case only."""
    try:
        near = sorted(each.name for each in path.parent.iterdir())
    except OSError:
        return None
    stem = path.stem.casefold()
    alike = [name for name in near if Path(name).stem.casefold() == stem and name != path.name]
    return min(alike, key=lambda name: name.casefold() != path.name.casefold(), default=None)


def odd_kind(path: Path) -> str:
    """What a path is that is neither a regular file nor a folder; empty if it is, or is nothing."""
    try:
        status = path.stat()
    except OSError as error:
        return "a link that leads back to itself" if error.errno == errno.ELOOP else ""
    known = stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)
    return "" if known else _kind(status)[1]


def open_file(path: Path) -> BinaryIO:
    """Open a regular file for reading.

    Raises:
        OSError: There is none, it cannot be opened, or is of another kind.
    """
    _check(path, path.stat())  # opening alone can act on a device
    file = os.fdopen(os.open(path, os.O_RDONLY | _WAIT_NOT), "rb")
    try:
        _check(path, os.fstat(file.fileno()))  # it may have been replaced meanwhile
    except OSError:
        file.close()
        raise
    return file


def read_file(path: Path) -> bytes:
    """The whole content of a regular file.

    Raises:
        OSError: There is none, it cannot be read, is of another kind, or larger than the free
            memory.
    """
    with open_file(path) as file:
        size, free = os.fstat(file.fileno()).st_size, free_memory()
        if free is not None and size > free:
            told = f"{size / 1e9:,.1f} GB, more than the {free / 1e9:,.1f} GB of free memory"
            raise OSError(errno.EFBIG, told, str(path))
        return file.read()


def read_text(path: Path) -> str:
    """The whole content of a regular file of UTF-8, such as JSON or TOML.

    Raises:
        OSError: See ``read_file``.
        UnicodeDecodeError: It is something else.
    """
    return read_file(path).decode("utf-8")


def _check(path: Path, status: os.stat_result) -> None:
    if stat.S_ISREG(status.st_mode):
        return
    raise OSError(*_kind(status), str(path))


def _kind(status: os.stat_result) -> tuple[int, str]:
    """The error and the name of what is no regular file."""
    return next((number, kind) for is_, number, kind in _KINDS if is_(status.st_mode))


def read_bytes(path: Path) -> bytes:
    """The whole file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read (a folder, no permission, a failing disk).
    """
    try:
        return read_file(path)
    except (FileNotFoundError, NotADirectoryError):
        raise SceneNotFoundError(f"a file at {path}", found="none", fix="Check the path.") from None
    except OSError as error:
        raise SceneFormatError(
            f"{path} to be a readable file",
            found=error.strerror or type(error).__name__,
            fix="Check that it is a file and that you may read it.",
        ) from None
