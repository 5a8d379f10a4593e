"""Progress: how long work tells a caller how far it is.

A ``Progress`` is any callable that takes a stage's name and the fraction of it that is done, from
0 to 1. Library functions take one and default to ``silent``; the command line passes a rich bar.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeAlias

__all__ = ["Progress", "blocks", "silent"]

Progress: TypeAlias = Callable[[str, float], None]


def silent(stage: str, fraction: float) -> None:
    """Report to nobody."""


def blocks(total: int, size: int, stage: str, progress: Progress) -> Iterator[tuple[int, int]]:
    """Consecutive ``(start, stop)`` pieces of ``range(total)``, reporting after each."""
    progress(stage, 0.0)
    for start in range(0, total, size):
        stop = min(start + size, total)
        yield start, stop
        progress(stage, stop / total)
