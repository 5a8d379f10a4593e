"""Ctrl-C that waits for the end of a step.

Promise: while the block runs, the first SIGINT or SIGTERM only sets a flag, so that a run stops
between two steps; a second one interrupts at once, as usual. The previous handlers are restored.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Termination(KeyboardInterrupt):
    """SIGTERM, as schedulers send it: cleanup runs as after Ctrl-C."""


class Interruption:
    """Whether the user asked to stop.

    Attributes:
        last: The last signal that asked the process to stop, whichever block received it.
    """

    last = signal.SIGINT

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002  (signal's)
        """Handle a signal."""
        Interruption.last = signal.Signals(number)
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def exit_code(stop: KeyboardInterrupt | None = None) -> int:
    """The exit code, by shell convention, of a process that stopped because it was asked to.

    Args:
        stop: What was raised, if the signal was not only noted.
    """
    return 128 + (signal.SIGTERM if isinstance(stop, Termination) else Interruption.last)


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Watch for signals in the main thread; in any other thread, do nothing."""
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
