"""One compilation of a kernel for all processes that want it at the same time.

Processes that begin together, such as runs of a benchmark or tests, want the same kernels, and each
compiled its own. Promise: a process that finds a kernel being compiled waits and then loads it from
the cache; where files cannot be locked, each compiles its own as before.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from numba.core.compiler_lock import global_compiler_lock

from splatseed.kernels.compilation import tell


def compile_once(compiled: Any) -> None:
    """Let a kernel be compiled by one process at a time.

    Args:
        compiled: What ``numba.njit`` returned. Without machine code or a cache on disk nothing is
            changed.
    """
    file: Any = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    index = getattr(file, "_index_path", None)
    if index is None:
        return
    compile_or_load = compiled.compile

    def compile_alone(signature: Any) -> Any:
        # Numba's lock among threads comes first: who waits for a file must not keep a thread that
        # has it from what it needs. Kernels call each other in no circle, so nor do their files.
        with global_compiler_lock, _alone(Path(f"{index}.lock")):
            return compile_or_load(signature)

    compiled.compile = compile_alone


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold a lock, if files can be locked there; waiting counts as compiling."""
    lock = FileLock(path)
    with suppress(OSError, NotImplementedError):  # a folder that is read-only, or on a network
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            tell(begins=True)
            try:
                lock.acquire()
            finally:
                tell(begins=False)
    try:
        yield
    finally:
        lock.release()
