"""Watching compilation: a first run is slow, and its user should know why.

Promise: watching does not import Numba; ``splatseed.kernels.jit`` tells the watchers once it is
imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

Watcher: TypeAlias = Callable[[bool], None]
"""Called with True when a compilation begins, with False when it ends; compilations can nest."""

_watchers: list[Watcher] = []


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Tell ``watcher`` of every compilation while the block runs."""
    _watchers.append(watcher)
    try:
        yield
    finally:
        _watchers.remove(watcher)


def tell(begins: bool) -> None:
    """Tell all watchers that a compilation begins or ends."""
    for watcher in tuple(_watchers):
        watcher(begins)
