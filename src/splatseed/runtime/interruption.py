"""Delay Ctrl-C to the end of a step.

While the block runs, the first SIGINT or SIGTERM sets a flag, so that a run stops between steps; a
second one raises KeyboardInterrupt at once. The previous handlers are restored.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Termination(KeyboardInterrupt):
    """SIGTERM, as schedulers send it; cleanup runs as after Ctrl-C."""


class Interruption:
    """A signal handler; ``requested`` is True after a signal, ``last`` is the last of any block."""

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
    """Return the shell's exit code for the signal that ended the process."""
    return 128 + (signal.SIGTERM if isinstance(stop, Termination) else Interruption.last)


@contextmanager
def interruption() -> Iterator[Interruption]:
    """Watch for signals in the main thread; in any other thread, do nothing."""
    flag = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = {n: signal.signal(n, flag) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
