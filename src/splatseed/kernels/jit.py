"""Numba decorators with this project's settings, in one place.

Promise: a kernel compiled here divides by zero as NumPy does (Numba's Python semantics turn it into
a SystemError inside ``prange``), releases the GIL, is cached on disk, and never reorders
floating-point sums, so its bytes do not depend on the number of threads or on the cache.

A cached kernel is keyed on the contents of its own file and of every file reachable through its
imports (``splatseed.kernels.sources``), since kernels use functions and constants of other files.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config, event

from splatseed.kernels.compilation import tell
from splatseed.kernels.sharing import compile_once
from splatseed.kernels.sources import source_digest

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


def kernel(function: F) -> F:
    """Compile a function whose ``parallel_range`` loops run on all threads."""
    return _compile(function, parallel=True)


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
    _key_on_sources(compiled, function)
    compile_once(compiled)
    return cast("F", compiled)


def _key_on_sources(compiled: Any, function: Callable[..., Any]) -> None:
    """Make cached machine code stale when any file changes that the function may be built from.

    Numba checks only the function's own file and has no setting for more, so its stamp of the
    source is replaced. Where there is no such stamp, as without a compiler (``NUMBA_DISABLE_JIT``),
    or no source to read, as in an archive, Numba's own check stays.
    """
    file: Any = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if hasattr(file, "_source_stamp"):
        with suppress(OSError):
            path = Path(function.__code__.co_filename)
            digest = source_digest(path, function.__module__)
            file._source_stamp = digest  # noqa: SLF001  (there is no public way)
            # Checked before the rest is unpickled, which may name modules that no longer exist.
            file._version = f"{numba.__version__} {digest}"  # noqa: SLF001  (there is no public way)
