"""How many threads this process uses, where several processes share a machine.

Promise: results do not depend on the number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from splatseed.progress import thread_limit

THREAD_VARIABLES = (
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)


def cores() -> int:
    """How many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows and macOS
        return os.cpu_count() or 1


def slot_environment(threads: int, gpu: str = "") -> dict[str, str]:
    """The variables that tell a process its share of the machine.

    Args:
        threads: Its threads.
        gpu: Its GPU, as in ``CUDA_VISIBLE_DEVICES``; empty to leave the choice to PyTorch.
    """
    environment = dict.fromkeys(THREAD_VARIABLES, str(threads))
    # Idle threads of one pool would take the cores from the other: see splatseed.cli.
    environment["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "passive")
    return {**environment, "CUDA_VISIBLE_DEVICES": gpu} if gpu else environment


@contextmanager
def few_threads(threads: int) -> Iterator[None]:
    """Let kernels and ``in_threads`` use at most this many threads while the block runs."""
    import numba  # noqa: PLC0415  (slow to import)

    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]  # absent from Numba's stubs
    limit = thread_limit.set(threads)
    try:
        yield
    finally:
        thread_limit.reset(limit)
        numba.set_num_threads(before)
