"""What every reader must do with any bytes: read them, or raise one of our errors."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from splatseed.errors import SplatseedError


def assert_only_our_errors(
    read: Callable[[Path], object],
    target: Path,
    data: bytes,
    little_memory: Callable[[], AbstractContextManager[None]],
) -> None:
    target.write_bytes(data)
    with little_memory():
        try:
            read(target)
        except SplatseedError as error:
            assert str(target) in str(error)  # noqa: PT017  (no error is as good as ours)
