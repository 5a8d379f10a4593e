"""The peak memory of a process."""

from __future__ import annotations

import sys
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_bytes() -> int | None:
    """The peak memory of this process so far, in bytes; None where the system does not tell.

    On Linux, since the program was loaded: getrusage also counts the process that started it.
    """
    try:
        lines = STATUS.read_text("ascii", "replace").splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        return _of_getrusage()
    return int(kilobytes) * 1024


def _of_getrusage() -> int | None:
    try:
        import resource  # noqa: PLC0415  (not on Windows)
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
