"""Numba decorators with this project's settings, in one place.

Promise: a kernel compiled here divides by zero as NumPy does (Numba's Python semantics turn it into
a SystemError inside ``prange``), releases the GIL, is cached on disk, and never reorders
floating-point sums, so its bytes do not depend on the number of threads or on the cache.

A cached kernel is keyed on its own file alone: kernels call only functions of their own file.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import config

__all__ = ["always_inline", "inline", "kernel", "parallel_range"]

# TBB, where a distribution ships it, can hang at interpreter exit; a user's own choice stands.
if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # type: ignore[attr-defined]

parallel_range = numba.prange

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a function whose ``parallel_range`` loops run on all threads."""
    compiled: Any = numba.njit(cache=True, parallel=True, error_model="numpy", nogil=True)(function)
    return cast("F", compiled)


def inline(function: F) -> F:
    """Compile a serial function, or a helper that kernels of the same file call."""
    compiled: Any = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
    return cast("F", compiled)


def always_inline(function: F) -> F:
    """Compile a helper into every kernel that calls it, for calls that are too many to be calls.

    A call passes every array as seven numbers and counts references with locked additions; where the
    compiler has its way (``inline``), it declines for large helpers, and kernels of many helpers
    compile in half of the time.
    """
    compiled: Any = numba.njit(cache=True, error_model="numpy", nogil=True, forceinline=True)(
        function
    )
    return cast("F", compiled)
