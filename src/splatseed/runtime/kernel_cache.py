"""Choose the folder in which Numba caches a module's machine code.

Numba checks only the file that holds a kernel, but kernels also use functions and constants of
other files. So each module has its own folder, named by a hash of all sources that the module
reaches through imports at the top of files, and of Numba's version. Machine code of other sources
lies in other folders and is never loaded.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import time
from contextlib import suppress
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

import numba
from numba.core import config
from platformdirs import user_cache_path

from splatseed.runtime.fingerprint import fingerprint

STALE_DAYS = 30
"""Folders of earlier sources are removed once no process has used them for this long."""
_IMPORT = re.compile(
    rb"^(?:from (?P<module>[\w.]+) import (?P<names>\([^)]*\)|.*)|import (?P<package>[\w.]+))",
    re.MULTILINE,
)


@cache
def cache_folder(module: str) -> Path | None:
    """Create the cache folder of a loaded module; remove those of its earlier sources.

    It lies in ``NUMBA_CACHE_DIR`` if the user sets that, else in the user's cache folder. None if
    no such folder can be written or the sources cannot be read: kernels are then not cached.
    """
    try:
        digest = fingerprint(*map(_digest, sorted(reached_files(module).values())))
        set_by_user = config.CACHE_DIR  # type: ignore[attr-defined]  # absent from Numba's stubs
        base = Path(set_by_user or user_cache_path("splatseed", appauthor=False) / "kernels")
        folder = base / f"{module}-{fingerprint(digest, numba.__version__)[:16]}"
        is_new = not folder.is_dir()
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return None
    if is_new:
        for other in base.glob(f"{module}-*"):
            with suppress(OSError):
                if time.time() - other.stat().st_mtime > STALE_DAYS * 86_400:
                    shutil.rmtree(other)
    return folder if os.access(folder, os.W_OK) else None


def reached_files(module: str) -> dict[str, Path]:
    """Find the files that a module's kernels may be built from, by module name.

    These are the files of its package and of splatseed that it imports, directly or through others.
    The module must be loaded, or at least all that it imports at its top.
    """
    packages, waiting = {"splatseed", module.partition(".")[0]}, [module]
    reached: dict[str, Path] = {}
    while waiting:
        name = waiting.pop()
        path = getattr(sys.modules.get(name), "__file__", None)
        if path and name not in reached and name.partition(".")[0] in packages:
            reached[name] = Path(path)
            waiting.extend(_imported_names(name, Path(path)))
    return reached


@cache
def _digest(path: Path) -> str:
    return fingerprint(path.read_bytes())


@cache
def _imported_names(module: str, path: Path) -> tuple[str, ...]:
    """List what the imports at the top of a module's file may name."""
    imported = list[str]()
    for match in _IMPORT.finditer(path.read_bytes()):
        source = (match["module"] or match["package"]).decode()
        with suppress(ImportError):  # a relative import within a text
            source = resolve_name(source, sys.modules[module].__package__)
        names = re.findall(r"\w+", (match["names"] or b"").decode())
        imported += [source, *(f"{source}.{name}" for name in names)]
    return tuple(imported)
