"""Telling who waits that a kernel is being compiled, without importing Numba.

``splatseed.runtime.jit`` tells the watchers once it is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_watchers: list[Callable[[bool], None]] = []


@contextmanager
def watched(watcher: Callable[[bool], None]) -> Iterator[None]:
    """Call ``watcher`` with True when a compilation begins, False when one ends; they can nest."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def tell(begins: bool) -> None:
    """Tell all watchers that a compilation begins or ends."""
    for watcher in tuple(_watchers):
        watcher(begins)
