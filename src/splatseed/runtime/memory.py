"""Measure free memory, and refuse requests that cannot fit.

Estimates are lower bounds: a refused request cannot fit, an accepted one may not. Where free memory
is unknown, nothing is refused.
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
"""Bytes of a process without points: libraries, compiled kernels, and their slack."""
UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def check_memory(count: int, bytes_each: int, what: str, *, found: str = "", fix: str) -> None:
    """Raise a ``ParameterError`` if a number of items does not fit into free memory.

    Args:
        count: The number of items.
        bytes_each: Bytes per item.
        what: The items' name.
        found: The request, for the message; the count if empty.
        fix: What the user can do; ``{limit}`` in it becomes the number that fits.
    """
    free = free_memory()
    if free is None or count * bytes_each <= free:
        return
    limit = max(free // bytes_each, 0)
    raise ParameterError(
        f"at most {limit:,} {what}, which the {free / 1e9:.1f} GB of free memory hold",
        found=found or f"{count:,}",
        fix=fix.replace("{limit}", str(limit)),
    )


def parse_bytes(text: str) -> int:
    """Parse an amount of memory: 4G, 500M, or a number of bytes."""
    plain = text.strip().upper().removesuffix("B").removesuffix("I")
    number, unit = (plain[:-1], UNITS[plain[-1]]) if plain[-1:] in UNITS else (plain, 1)
    with suppress(ValueError):
        if 0 < (amount := float(number)) < float("inf"):
            return int(amount * unit)
    raise ParameterError(
        "an amount of memory such as 4G or 500M", found=repr(text), fix="Give such an amount."
    )


def format_bytes(amount: int, *, up: bool = False) -> str:
    """Format bytes as tenths of GB or whole MB; ``up`` rounds up."""
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
    return f"`memory='{format_bytes(amount, up=True).replace(',', '')[:-1].replace(' ', '')}'`"


def free_memory() -> int | None:
    """Return the bytes that this process can still allocate; None if unknown."""
    known = [free for free in (_of_machine(), _of_container()) if free is not None]
    return min(known, default=None)


def _field(path: str, name: str) -> int | None:
    """Read the number after a name in a system file, such as ``VmHWM: 12 kB``."""
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
    """Return what a container's limit leaves; cached files, which can be dropped, count as free."""
    with suppress(OSError, ValueError):
        limit, used = (
            (CGROUP / f"memory.{name}").read_text("ascii").strip() for name in ("max", "current")
        )
        files = _field(str(CGROUP / "memory.stat"), "inactive_file ") or 0
        return max(int(limit) - int(used) + files, 0)  # "max" is no number: no limit
    return None


def resident_bytes() -> int | None:
    """Return the memory that this process holds now, in bytes; None if unknown (not on Linux)."""
    kilobytes = _field("/proc/self/status", "VmRSS:")
    return None if kilobytes is None else kilobytes * 1024


def peak_bytes() -> int | None:
    """Return the peak memory of this process in bytes; None if unknown.

    On Linux it is read from /proc, since getrusage includes the process that started this one.
    """
    if (kilobytes := _field("/proc/self/status", "VmHWM:")) is not None:
        return kilobytes * 1024
    try:
        import resource  # noqa: PLC0415  (not on Windows)
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
