"""Telling who waits that a kernel is being compiled, without importing Numba.

``splatseed.runtime.jit`` tells the watchers once it is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_watchers: list[Callable[[bool], None]] = []


@contextmanager
def watched(watcher: Callable[[bool], None]) -> Iterator[None]:
    """Tell ``watcher`` of every compilation while the block runs.

    Args:
        watcher: Called with True when one begins, with False when one ends; they can nest.
    """
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def tell(begins: bool) -> None:
    """Tell all watchers that a compilation begins or ends."""
    for watcher in tuple(_watchers):
        watcher(begins)
