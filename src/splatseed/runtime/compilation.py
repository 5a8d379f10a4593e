"""Notify watchers while a kernel compiles, without importing Numba.

``splatseed.runtime.jit`` sends the notifications once it is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

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
