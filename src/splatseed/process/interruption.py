"""Ctrl-C that waits for the end of a step.

Promise: while the block runs, the first SIGINT or SIGTERM only raises a flag, so that a run stops
between two steps; a second one interrupts at once, as usual. The handlers of before come back.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Interruption", "exit_code", "interruption"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Whether the user asked to stop.

    Attributes:
        last: The signal that the process was last asked to stop by, whichever block heard it.
    """

    last = signal.SIGINT

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002  (signal's)
        """Be told of a signal."""
        Interruption.last = signal.Signals(number)
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def exit_code() -> int:
    """What a process exits with that stopped as it was asked to, as shells have it."""
    return 128 + Interruption.last


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Watch for signals; other threads than the main one cannot, and are left as they are."""
    flag = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = {number: signal.signal(number, flag) for number in SIGNALS}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
