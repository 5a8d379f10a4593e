"""Removing what killed processes leave behind: hidden partial outputs.

Promise: what a process is still writing to is never removed, because the process holds a lock on
it; on systems without such locks nothing is removed.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_SETTLED = 5.0
"""Seconds after which a partial that nobody holds counts as a leftover: it is locked right after
it is made."""
_LOG = logging.getLogger(__name__)


@contextmanager
def held(partial: Path) -> Iterator[Callable[[], None]]:
    """While the block runs, a partial can be marked as being written to.

    Args:
        partial: The file or folder.

    Yields:
        A function that marks it, to be called once the partial exists.
    """
    locks: list[int] = []
    try:
        yield lambda: locks.extend(_lock(partial))
    finally:
        for lock in locks:
            os.close(lock)


def remove_leftovers(target: Path) -> None:
    """Remove, and log, the partials of processes that were killed while they wrote ``target``."""
    start = re.escape(f".{target.name}.partial-") + "[0-9a-f]{8}"
    folder, file = re.compile(start), re.compile(start + re.escape(target.suffix))
    with suppress(OSError):
        for path in target.parent.iterdir():
            if path.is_symlink():
                continue
            if (folder.fullmatch(path.name) and path.is_dir()) or (
                file.fullmatch(path.name) and path.is_file()
            ):
                _remove_unless_held(path)


def _remove_unless_held(leftover: Path) -> None:
    with suppress(OSError):
        if time.time() - leftover.stat().st_mtime < _SETTLED:
            return
        for lock in _lock(leftover):
            try:
                remove_tree(leftover) if leftover.is_dir() else leftover.unlink()
                _LOG.warning("Removed %s, left by a run that was killed.", leftover)
            finally:
                os.close(lock)


def _lock(path: Path) -> list[int]:
    """A descriptor that locks a file or folder until it is closed.

    None if another process holds the lock, or the system has none.
    """
    try:
        import fcntl  # noqa: PLC0415  (not on Windows)
    except ImportError:
        return []
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return []
    return [descriptor]


def remove_tree(folder: Path) -> None:
    """Remove one of our own folders, even if folders in it are read-only."""
    folder.chmod(0o700)
    for parent, names, _ in os.walk(folder):
        for name in names:
            child = Path(parent, name)
            if not child.is_symlink():  # a link's target is the user's
                child.chmod(0o700)
    shutil.rmtree(folder)
