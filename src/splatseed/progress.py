"""Report progress and notes to the caller; work in threads.

A ``Progress`` is any callable that takes a stage's name and the fraction of it that is done, from
0 to 1. Library functions default to ``silent``; the command line passes a progress bar. A ``Note``
takes a ``Finding``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeAlias

from splatseed.findings import Finding

Progress: TypeAlias = Callable[[str, float], None]
Note: TypeAlias = Callable[[Finding], None]

extraction_progress: ContextVar[Progress] = ContextVar("extraction_progress")
"""Called while a video or archive is extracted (``io.extraction``); unset: shown nowhere."""
thread_limit: ContextVar[int | None] = ContextVar("thread_limit", default=None)
"""Maximum threads of ``in_threads``; None for one per available CPU."""


def silent(stage: str, fraction: float) -> None:
    """Ignore the progress."""


def silent_note(finding: Finding) -> None:
    """Ignore the finding."""


def blocks(total: int, size: int, stage: str, progress: Progress) -> Iterator[tuple[int, int]]:
    """Yield consecutive ``(start, stop)`` pieces of ``range(total)``; report after each."""
    progress(stage, 0.0)
    for start in range(0, total, size):
        stop = min(start + size, total)
        yield start, stop
        progress(stage, stop / total)


def available_cpus() -> int:
    """Return how many CPUs this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows and macOS
        return os.cpu_count() or 1


def num_threads() -> int:
    """Return the number of threads to compute with: ``thread_limit``, or one per available CPU."""
    return thread_limit.get() or available_cpus()


def in_threads(
    work: Callable[[int, int], None], total: int, size: int, stage: str, progress: Progress
) -> None:
    """Call ``work(start, stop)`` on pieces of ``range(total)`` on all cores; report after each.

    ``work`` should release the GIL. An interrupt is raised once the running pieces are done: with
    SciPy's own ``workers``, threads go on with arrays that are already freed, and crash.
    """
    progress(stage, 0.0)
    starts = range(0, total, size)
    pool = ThreadPoolExecutor(num_threads())
    try:
        pieces = pool.map(lambda start: work(start, min(start + size, total)), starts)
        for done, _ in enumerate(pieces, start=1):
            progress(stage, done / len(starts))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
