"""Progress: how long work tells a caller how far it is.

A ``Progress`` is any callable that takes a stage's name and the fraction of it that is done, from
0 to 1. Library functions take one and default to ``silent``; the command line passes a rich bar. A
``Note`` is called with a sentence that the user should read.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeAlias

Progress: TypeAlias = Callable[[str, float], None]
Note: TypeAlias = Callable[[str], None]

thread_limit: ContextVar[int | None] = ContextVar("thread_limit", default=None)
"""Most threads of ``in_threads``; as many as there are cores if None."""


def silent(stage: str, fraction: float) -> None:
    """Report to nobody."""


def silent_note(sentence: str) -> None:
    """Discard the sentence."""


def blocks(total: int, size: int, stage: str, progress: Progress) -> Iterator[tuple[int, int]]:
    """Consecutive ``(start, stop)`` pieces of ``range(total)``, reporting after each."""
    progress(stage, 0.0)
    for start in range(0, total, size):
        stop = min(start + size, total)
        yield start, stop
        progress(stage, stop / total)


def in_threads(
    work: Callable[[int, int], None], total: int, size: int, stage: str, progress: Progress
) -> None:
    """Call ``work(start, stop)`` on pieces of ``range(total)`` on all cores; report after each.

    For work that releases the GIL. An interrupt is raised only once the running pieces are done:
    SciPy's own ``workers`` keep running on arrays that are then freed, which crashes.
    """
    progress(stage, 0.0)
    starts = range(0, total, size)
    pool = ThreadPoolExecutor(thread_limit.get() or os.cpu_count())
    try:
        pieces = pool.map(lambda start: work(start, min(start + size, total)), starts)
        for done, _ in enumerate(pieces, start=1):
            progress(stage, done / len(starts))
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
