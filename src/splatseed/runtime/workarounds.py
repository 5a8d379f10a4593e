"""Changes to how other libraries behave, each with its reason.

Each relies on something that the library does not promise, so each has a test in
``tests/runtime/test_workarounds.py`` that fails once the library changes.
"""

from __future__ import annotations

import ctypes
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock, Timeout
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from splatseed.progress import notify

# Numba: parallel loops of several Python threads ----------------------------------------------

_one_at_a_time = threading.RLock()
"""Held by the thread that runs a kernel if the threading layer runs one loop at a time."""


def serialise_calls(function: Any) -> None:
    """Let Python threads call a parallel kernel at once.

    Numba's workqueue layer, the only one without OpenMP and TBB, ends the process when two threads
    run parallel loops at once. With it, a lock lets kernels run one after another.
    """
    if isinstance(function, CPUDispatcher):  # not with NUMBA_DISABLE_JIT
        function.__class__ = _OneAtATime


class _OneAtATime(CPUDispatcher):
    """A kernel under the lock, until any kernel's first call has loaded a layer that needs none."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if _layer_takes_threads():
            self.__class__ = CPUDispatcher  # type: ignore[assignment]  # later calls cost no more
            return self(*arguments, **named)
        with _one_at_a_time:
            return super().__call__(*arguments, **named)


def _layer_takes_threads() -> bool:
    """Whether the threading layer takes loops of several threads; False before it is loaded."""
    try:
        return bool(numba.threading_layer() != "workqueue")  # type: ignore[attr-defined]  # absent from Numba's stubs
    except ValueError:  # the first call loads it
        return False


if hasattr(os, "register_at_fork"):  # not on Windows
    # A child forked during another thread's kernel would inherit a lock that nobody releases, and a
    # threading layer in the middle of a loop.
    os.register_at_fork(
        before=_one_at_a_time.acquire,
        after_in_parent=_one_at_a_time.release,
        after_in_child=_one_at_a_time.release,
    )


# Numba: compilation by several processes ------------------------------------------------------


def compile_in_one_process(function: Any, folder: Path) -> None:
    """Let one process at a time compile a function; others wait, then load it from the cache.

    Numba compiles in every process that finds no machine code in the cache, which takes as long as
    a small run, on every core; and of two processes that write the cache's index at once, one loses
    its entry.
    """
    if not isinstance(function, CPUDispatcher):  # NUMBA_DISABLE_JIT
        return
    lock = folder / f"{re.sub(r'[^.a-zA-Z0-9_]', '_', function.py_func.__qualname__)}.lock"
    compile_or_load: Any = function.compile

    def compile_alone(signature: Any) -> Any:
        # Numba's lock among threads comes first: a thread that waits for a file must not hold up
        # the one that has it. Kernels do not call each other in circles, so neither do their locks.
        with global_compiler_lock, _locked(lock):
            return compile_or_load(signature)

    function.compile = compile_alone  # type: ignore[method-assign, assignment]


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock file if the file system has locks; waiting counts as compiling."""
    lock = FileLock(path)
    with suppress(OSError, NotImplementedError):  # read-only, or on a network
        try:
            lock.acquire(timeout=0)
        except Timeout:
            notify(begins=True)
            try:
                lock.acquire()
            finally:
                notify(begins=False)
    try:
        yield
    finally:
        lock.release()


# glibc: memory of training steps --------------------------------------------------------------


def keep_freed_memory() -> bool:
    """Let glibc keep the memory that a training step frees for the next step, in this process.

    By default it returns large blocks to the system at once, and every step waits for the system to
    clear the pages again. Results stay the same. While Gaussians are added, blocks of earlier sizes
    lie idle: a run that grew from 30,000 to 250,000 took 8 % more memory at its peak.

    Returns whether the C library took the settings.
    """
    with suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        trim_threshold, mmap_threshold = -1, -3  # of mallopt(3)
        return all(
            any(mallopt(option, size) for size in (1 << 30, 1 << 25))  # older versions: 32 MiB
            for option in (trim_threshold, mmap_threshold)
        )
    return False
