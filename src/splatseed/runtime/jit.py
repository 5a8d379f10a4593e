"""Numba decorators with this project's settings.

A kernel divides by zero as NumPy does (Numba's Python semantics raise a SystemError inside
``prange``), releases the GIL, and never reorders floating-point sums, so that results do not depend
on the number of threads or on the cache. Machine code is cached on disk (``kernel_cache``); if
several processes need a kernel, one compiles it and the others load it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config, event

from splatseed.progress import notify
from splatseed.runtime.kernel_cache import cache_folder
from splatseed.runtime.workarounds import compile_in_one_process, serialise_calls


class _Notifier(event.Listener):
    """Passes Numba's compilation events on to watchers."""

    def on_start(self, event: object) -> None:  # noqa: ARG002  (Numba's interface)
        notify(begins=True)

    def on_end(self, event: object) -> None:  # noqa: ARG002  (Numba's interface)
        notify(begins=False)


event.register("numba:compile", _Notifier())  # type: ignore[no-untyped-call]  # Numba is untyped

parallel_range = numba.prange

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function whose ``parallel_range`` loops run on all threads.

    Several Python threads may call it at once. Serial compiled functions must not call it, since
    such a call takes no lock.
    """
    compiled = _compile(function, parallel=True)
    serialise_calls(compiled)
    return compiled


def inline(function: F) -> F:
    """Compile a serial function, or a helper that kernels call."""
    return _compile(function)


def always_inline(function: F) -> F:
    """Compile a helper into every kernel that calls it.

    A call passes each array as seven numbers and counts references with locked additions, too much
    for a helper in an inner loop. Left to choose (``inline``), the compiler does not inline large
    helpers; kernels with many helpers then compile in half the time.
    """
    return _compile(function, forceinline=True)


def _compile(function: F, **options: bool) -> F:
    njit: Any = numba.njit  # its annotations list every option by name
    folder = cache_folder(function.__module__)
    with _cache_in(folder):
        compiled = njit(
            cache=folder is not None, error_model="numpy", nogil=True, **options
        )(function)  # fmt: skip
    if folder is not None:
        compile_in_one_process(compiled, folder)
    return cast("F", compiled)


@contextmanager
def _cache_in(folder: Path | None) -> Iterator[None]:
    """Have Numba cache the functions that it decorates in the block in a folder."""
    settings: Any = config  # untyped
    before = settings.CACHE_DIR
    settings.CACHE_DIR = before if folder is None else str(folder)
    try:
        yield
    finally:
        settings.CACHE_DIR = before
