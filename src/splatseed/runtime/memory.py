"""Memory: how much is free, how much was taken, and refusing early what cannot fit.

Promise: where the system does not tell how much is free, nothing is refused. An estimate counts
only what is certainly held at once, so what is refused would have failed; what is admitted may
still fail.
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from pathlib import Path

from splatseed.errors import ParameterError

CGROUP = Path("/sys/fs/cgroup")
PROCESS = 300 << 20
"""Bytes of a process before it holds any points: libraries, compiled kernels, and their slack."""
UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def check_memory(count: int, bytes_each: int, what: str, *, found: str = "", fix: str) -> None:
    """Refuse, by a ``ParameterError``, things that do not fit into the free memory.

    Args:
        count: How many are wanted.
        bytes_each: What each takes.
        what: Their name.
        found: What was asked for, in words; the count when left out.
        fix: What the user can do; ``{most}`` in it becomes the number that fits.
    """
    free = free_memory()
    if free is None or count * bytes_each <= free:
        return
    most = max(free // bytes_each, 0)
    raise ParameterError(
        f"at most {most:,} {what}, which the {free / 1e9:.1f} GB of free memory hold",
        found=found or f"{count:,}",
        fix=fix.replace("{most}", str(most)),
    )


def bytes_of(text: str) -> int:
    """An amount of memory such as 4G, 500M or a number of bytes; else a ``ParameterError``."""
    plain = text.strip().upper().removesuffix("B").removesuffix("I")
    number, unit = (plain[:-1], UNITS[plain[-1]]) if plain[-1:] in UNITS else (plain, 1)
    with suppress(ValueError):
        if 0 < (amount := float(number)) < float("inf"):
            return int(amount * unit)
    raise ParameterError(
        "an amount of memory such as 4G or 500M", found=repr(text), fix="Give such an amount."
    )


def words_of(amount: int, *, up: bool = False) -> str:
    """Bytes in words: tenths of GB, or whole MB; rounded up on request."""
    unit, name, digits = (1 << 30, "GB", 1) if amount >= 1 << 30 else (1 << 20, "MB", 0)
    scaled = amount / unit * 10**digits
    rounded = (math.ceil(scaled) if up else round(scaled)) / 10**digits
    return f"{rounded:,.{digits}f} {name}"


def memory_argument(amount: int) -> str:
    """Format the argument that allows at least ``amount`` bytes, for a message.

    Example:
        >>> memory_argument(4_400_000_000)
        "`memory='4.1G'`"
    """
    return f"`memory='{words_of(amount, up=True).replace(',', '')[:-1].replace(' ', '')}'`"


def free_memory() -> int | None:
    """Bytes that this process can still take; None where the system does not tell."""
    known = [free for free in (_of_machine(), _of_container()) if free is not None]
    return min(known, default=None)


def _field(path: str, name: str) -> int | None:
    """The number behind a name in a file of the system, such as ``VmHWM: 12 kB``."""
    with suppress(OSError):
        for line in Path(path).read_text("utf-8", "replace").splitlines():
            if line.startswith(name):
                return int(line.split()[1])
    return None


def _of_machine() -> int | None:
    if (kilobytes := _field("/proc/meminfo", "MemAvailable:")) is not None:
        return kilobytes * 1024
    with suppress(AttributeError, OSError, ValueError):  # not on Windows
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _of_container() -> int | None:
    """What a container's limit leaves; cached files count as free, as the system drops them."""
    with suppress(OSError, ValueError):
        limit, used = (
            (CGROUP / f"memory.{name}").read_text("ascii").strip() for name in ("max", "current")
        )
        files = _field(str(CGROUP / "memory.stat"), "inactive_file ") or 0
        return max(int(limit) - int(used) + files, 0)  # "max" is no number: no limit
    return None


def peak_bytes() -> int | None:
    """The peak memory of this process so far, in bytes; None where the system does not tell.

    On Linux, since the program was loaded: getrusage also counts the process that started it.
    """
    if (kilobytes := _field("/proc/self/status", "VmHWM:")) is not None:
        return kilobytes * 1024
    try:
        import resource  # noqa: PLC0415  (not on Windows)
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
