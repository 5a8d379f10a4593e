"""Workers: processes that have runs, and whether they are still alive.

Notation: a worker is named ``HOST:PID@SPACE``, where SPACE distinguishes sets of process numbers:
those of another boot, or of another container on the same host. Promise: a worker counts as gone
only if its process number is free where it ran, or if it sent no heartbeat for ``STALE_SECONDS``.
"""

from __future__ import annotations

import os
import socket
from functools import cache
from pathlib import Path

HEARTBEAT_SECONDS = 10.0
STALE_SECONDS = 180.0
"""Many heartbeats: clocks of two machines differ, and a busy disk delays heartbeats."""


def worker_name() -> str:
    """This process as a worker."""
    return f"{socket.gethostname()}:{os.getpid()}@{_space()}"


def is_gone(worker: str, heartbeat: float | None, now: float) -> bool:
    """Whether a worker is gone.

    Args:
        worker: Its name, as ``worker_name`` gave it.
        heartbeat: Its last heartbeat, seconds since 1970.
        now: The time, likewise.
    """
    if heartbeat is None or now - heartbeat > STALE_SECONDS:
        return True
    place, _, space = worker.partition("@")
    host, _, number = place.rpartition(":")
    if (host, space) != (socket.gethostname(), _space()) or not number.isdecimal():
        return False
    return not _exists(int(number))


def _exists(process: int) -> bool:
    if os.name != "posix":  # elsewhere os.kill would end it
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True


@cache
def _space() -> str:
    """The set of process numbers that this one belongs to; empty if the system does not tell."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text("ascii")[:8]
        return f"{boot}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:
        return ""
