"""Measurements that need what may be absent here: a scene, a program, a library."""

from __future__ import annotations

from collections.abc import Callable

from splatseed.errors import SplatseedError

__all__ = ["or_skip"]


def or_skip(what: str, measure: Callable[[], None]) -> None:
    """Measure, or say why not."""
    try:
        measure()
    except SplatseedError as error:
        print(f"SKIPPED {what}: {error}\n")
