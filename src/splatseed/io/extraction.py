"""Photographs inside other files (a video, an archive), extracted once into the user's cache.

A folder's name ends in a fingerprint of its content's source and of how it was chosen, so another
source never takes its place. It appears complete or not at all, is used again by later calls, and
is removed once no call has used it for ``UNUSED_DAYS``. Outputs copy photographs from here, since a
link would break then.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

from splatseed.errors import OutputError
from splatseed.io.files import open_file, translate_read_errors
from splatseed.io.staging import locked, remove, staged, translate_write_errors
from splatseed.progress import Progress, extraction_progress, silent
from splatseed.runtime.fingerprint import fingerprint

UNUSED_DAYS = 30
"""Extracted photographs are removed once no call has used them for this long."""
_SAMPLE = 1 << 20
"""Bytes at a file's start and at its end that identify it, with its size: headers and indices of
videos are there, and hashing gigabytes would take seconds at each call."""


def extracted(source: Path, facts: object, fill: Callable[[Path, Progress], None]) -> Path:
    """Return the folder of what ``fill`` extracts from a file; fill it if there is none yet.

    Args:
        source: The file or folder, for the name.
        facts: What determines the content: fingerprints and settings.
        fill: Writes into an empty folder.

    Raises:
        OutputError: The cache cannot be written.
    """
    base = _base()
    folder = base / f"{source.stem}-{fingerprint(facts)[:16]}"
    try:
        with translate_write_errors(folder):
            base.mkdir(parents=True, exist_ok=True)
            with locked(base, wait=True):  # of several processes, one extracts, the others wait
                if not folder.is_dir():
                    _remove_unused(base)
                    with staged(folder, folder=True) as partial:
                        fill(partial, extraction_progress.get(silent))
    except OutputError as error:
        where = "Photographs inside a file are extracted into the user's cache folder"
        fix = f"{error.fix} {where}, which XDG_CACHE_HOME sets on Linux."
        raise OutputError(error.expected, found=error.found, fix=fix) from error
    with suppress(OSError):  # a cache that others filled may be read-only
        os.utime(folder)
    return folder


def is_extracted(path: Path) -> bool:
    """Whether a file or folder lies in the cache of extracted photographs."""
    return _base().resolve() in path.resolve().parents


def identity(path: Path) -> str:
    """Fingerprint a large file by its size, first and last bytes."""
    with translate_read_errors(path), open_file(path) as file:
        first, size = file.read(_SAMPLE), os.fstat(file.fileno()).st_size
        file.seek(max(0, size - _SAMPLE))
        return fingerprint(size, first, file.read(_SAMPLE))


def _base() -> Path:
    return user_cache_path("splatseed", appauthor=False) / "captures"


def _remove_unused(base: Path) -> None:
    for folder in base.iterdir():
        with suppress(OSError):
            if time.time() - folder.stat().st_mtime > UNUSED_DAYS * 86_400:
                remove(folder)
