"""Report progress, findings and the compilation of kernels to the caller; work in threads.

A ``Progress`` is any callable that takes a stage's name and the fraction of it that is done, from
0 to 1. Library functions default to ``silent``; the command line passes a progress bar. A ``Note``
takes a ``Finding``. ``runtime.jit`` notifies watchers of compilation, which need not import Numba.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TypeAlias

from splatseed.findings import LEVELS, LOGGER, Finding

Progress: TypeAlias = Callable[[str, float], None]
Note: TypeAlias = Callable[[Finding], None]

extraction_progress: ContextVar[Progress] = ContextVar("extraction_progress")
"""Called while a video or archive is extracted (``io.recordings``); unset: shown nowhere."""
thread_limit: ContextVar[int | None] = ContextVar("thread_limit", default=None)
"""Threads of ``in_threads``; None for the default of ``num_threads``."""
_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")


COMPILATION = "compiling kernels"
"""The stage of compilation."""


def silent(stage: str, fraction: float) -> None:
    """Ignore the progress."""


def silent_note(finding: Finding) -> None:
    """Ignore the finding."""


def log_note(finding: Finding) -> None:
    """Log the finding, by default of the public functions; the record has it as ``finding``."""
    LOGGER.log(LEVELS[finding.severity], "%s", finding, extra={"finding": finding})


class StageTimes:
    """A ``Progress`` that times stages; a stage's time runs until the next one starts."""

    def __init__(self) -> None:
        self._started: list[tuple[str, float]] = []
        self._compiling = 0
        self._before = COMPILATION

    def __call__(self, stage: str, fraction: float) -> None:  # noqa: ARG002  (a Progress)
        """Record that ``fraction`` of ``stage`` is done."""
        if not self._started or self._started[-1][0] != stage:
            self._started.append((stage, time.perf_counter()))

    def seconds(self) -> dict[str, float]:
        """Return the wall time of each stage so far, in order of first appearance."""
        if not self._started:
            return {}
        ends = [start for _, start in self._started[1:]] + [time.perf_counter()]
        total: dict[str, float] = {}
        for (stage, start), end in zip(self._started, ends, strict=True):
            total[stage] = total.get(stage, 0.0) + end - start
        return total

    def compilation(self, begins: bool) -> None:
        """Count the time from the first compilation that begins to the last that ends, apart."""
        self._compiling += 1 if begins else -1
        if self._compiling != int(begins):  # nested in another
            return
        if begins:
            self._before = self._started[-1][0] if self._started else COMPILATION
        self._started.append((COMPILATION if begins else self._before, time.perf_counter()))


def blocks(total: int, size: int, stage: str, progress: Progress) -> Iterator[tuple[int, int]]:
    """Yield consecutive ``(start, stop)`` pieces of ``range(total)``; report after each."""
    progress(stage, 0.0)
    for start in range(0, total, size):
        stop = min(start + size, total)
        yield start, stop
        progress(stage, stop / total)


def available_cpus() -> int:
    """Return how many CPUs this process may use, by its affinity and its container's quota."""
    try:
        count = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows and macOS
        count = os.cpu_count() or 1
    with suppress(OSError, ValueError):  # "max": no quota
        quota, period = map(int, _CPU_MAX.read_text("ascii").split())
        count = min(count, max(1, round(quota / period)))
    return count


def num_threads(jobs: int = 1) -> int:
    """Return the number of threads to compute with.

    That is ``thread_limit``, or an equal share of the available CPUs among ``jobs`` processes, and
    at most what ``OMP_NUM_THREADS`` and ``NUMBA_NUM_THREADS`` allow a process.
    """
    values = (os.environ.get(f"{name}_NUM_THREADS", "") for name in ("OMP", "NUMBA"))
    first = (value.partition(",")[0].strip() for value in values)  # OpenMP's "4,2" nests
    limits = [int(value) for value in first if value.isdecimal() and int(value)]
    return thread_limit.get() or min([max(1, available_cpus() // jobs), *limits])


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


_watchers: list[Callable[[bool], None]] = []


@contextmanager
def watched(watcher: Callable[[bool], None]) -> Iterator[None]:
    """Call ``watcher`` with True when a compilation begins, False when it ends; they can nest."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def notify(begins: bool) -> None:
    """Notify all watchers that a compilation begins or ends."""
    for watcher in tuple(_watchers):
        watcher(begins)
