"""Numba decorators with this project's settings, in one place.

Promise: a kernel divides by zero as NumPy does (Numba's Python semantics turn it into a SystemError
inside ``prange``), releases the GIL, and never reorders floating-point sums, so its bytes do not
depend on the number of threads or on the cache. Of several processes that want it, one compiles it.

Numba's workqueue layer, the only one where there is neither OpenMP nor TBB, ends the process when
two threads run parallel loops at once. There a lock lets kernels run one after another.

Machine code is cached on disk, keyed on the contents of the kernel's own file and of every file of
its package or of splatseed that this one *reaches* through imports at the top of files, since
kernels use functions and constants of other files. Dates and places of files do not count.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from filelock import FileLock, Timeout
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from splatseed.runtime.compilation import tell

# TBB, where a distribution ships it, can hang at interpreter exit; a user's own choice stands.
if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # type: ignore[attr-defined]  # absent from Numba's stubs


class _Teller(event.Listener):
    """Passes Numba's events on."""

    def on_start(self, event: object) -> None:  # noqa: ARG002  (the interface's name)
        tell(begins=True)

    def on_end(self, event: object) -> None:  # noqa: ARG002  (the interface's name)
        tell(begins=False)


event.register("numba:compile", _Teller())  # type: ignore[no-untyped-call]  # Numba is untyped

parallel_range = numba.prange

F = TypeVar("F", bound=Callable[..., Any])

_IMPORT = re.compile(
    rb"^(?:from (?P<module>[\w.]+) import (?P<names>\([^)]*\)|.*)|import (?P<whole>[\w.]+))",
    re.MULTILINE,
)


def kernel(function: F) -> F:
    """Compile a function whose ``parallel_range`` loops run on all threads.

    Python threads may call it at once. Serial functions must not call it: they take no lock.
    """
    compiled: Any = _compile(function, parallel=True)
    if isinstance(compiled, CPUDispatcher):  # not with ``NUMBA_DISABLE_JIT``
        compiled.__class__ = _OneAtATime
    return cast("F", compiled)


_one_at_a_time = threading.RLock()
"""Held by the thread that runs a kernel, where the threading layer needs that."""


class _OneAtATime(CPUDispatcher):
    """A kernel under the lock, until the first call of any has loaded a layer that needs none."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if _threads_may_share():
            self.__class__ = CPUDispatcher  # type: ignore[assignment]  # a call then costs nothing more
            return self(*arguments, **named)
        with _one_at_a_time:
            return super().__call__(*arguments, **named)


def _threads_may_share() -> bool:
    """Whether the threading layer lets threads run loops at once; not if none is loaded."""
    try:
        return bool(numba.threading_layer() != "workqueue")  # type: ignore[attr-defined]  # absent from Numba's stubs
    except ValueError:  # the first call loads it
        return False


if hasattr(os, "register_at_fork"):  # not on Windows
    # A process that forks within another thread's kernel would inherit a lock that nobody releases,
    # and a layer in the midst of its work.
    os.register_at_fork(
        before=_one_at_a_time.acquire,
        after_in_parent=_one_at_a_time.release,
        after_in_child=_one_at_a_time.release,
    )


def inline(function: F) -> F:
    """Compile a serial function, or a helper that kernels call."""
    return _compile(function)


def always_inline(function: F) -> F:
    """Compile a helper into every kernel that calls it, for calls too frequent to be calls.

    A call passes every array as seven numbers and counts references with locked additions. Left to
    choose (``inline``), the compiler declines for large helpers; kernels with many helpers then
    compile in half the time.
    """
    return _compile(function, forceinline=True)


def _compile(function: F, **options: bool) -> F:
    njit: Any = numba.njit  # its annotations list every option by name
    compiled = njit(cache=True, error_model="numpy", nogil=True, **options)(function)
    # There is no cache without a compiler (``NUMBA_DISABLE_JIT``).
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if file is not None:
        _key_on_sources(file, function.__module__)
        _compile_once(compiled, Path(f"{file._index_path}.lock"))  # noqa: SLF001  (Numba has no public way)
    return cast("F", compiled)


def _key_on_sources(file: Any, module: str) -> None:
    """Replace Numba's stamp of the source, which is of the function's own file alone.

    Where no source can be read, as in an archive, it stays.
    """
    with suppress(OSError):
        if digests := sorted(_read(each)[0] for each in reached_files(module).items()):
            digest = hashlib.sha256(b"".join(digests)).hexdigest()
            file._source_stamp = digest  # noqa: SLF001  (there is no public way)
            # Checked before the rest is unpickled, which may name modules that no longer exist.
            file._version = f"{numba.__version__} {digest}"  # noqa: SLF001  (there is no public way)


def reached_files(module: str) -> dict[str, Path]:
    """The files that a module's kernels may be built from, by their modules' names.

    The module is loaded, or at least all that its first lines import; an ``OSError`` for a file
    that cannot be read.
    """
    packages, waiting = {"splatseed", module.partition(".")[0]}, [module]
    reached: dict[str, Path] = {}
    while waiting:
        name = waiting.pop()
        path = getattr(sys.modules.get(name), "__file__", None)
        if path and name not in reached and name.partition(".")[0] in packages:
            reached[name] = Path(path)
            waiting.extend(_read((name, Path(path)))[1])
    return reached


@cache
def _read(named: tuple[str, Path]) -> tuple[bytes, tuple[str, ...]]:
    """The digest of a module's file, and what its imports at the top may name."""
    name, path = named
    text, imported = path.read_bytes(), list[str]()
    for match in _IMPORT.finditer(text):
        source = (match["module"] or match["whole"]).decode()
        with suppress(ImportError):  # within a text, say
            source = resolve_name(source, sys.modules[name].__package__)
        names = re.findall(r"\w+", (match["names"] or b"").decode())
        imported += [source, *(f"{source}.{each}" for each in names)]
    return hashlib.sha256(text).digest(), tuple(imported)


def _compile_once(compiled: Any, path: Path) -> None:
    """Let one process at a time compile a kernel; others wait, and load it from the cache."""
    compile_or_load = compiled.compile

    def compile_alone(signature: Any) -> Any:
        # Numba's lock among threads comes first: who waits for a file must not keep a thread that
        # has it from what it needs. Kernels call each other in no circle, so nor do their files.
        with global_compiler_lock, _locked(path):
            return compile_or_load(signature)

    compiled.compile = compile_alone


@contextmanager
def _locked(path: Path) -> Iterator[None]:
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
