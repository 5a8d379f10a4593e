"""Free memory, and refusing early what cannot fit into it.

Promise: where the system does not tell how much is free, nothing is refused. An estimate counts
only what is certainly held at once, so what is refused would have failed; what is admitted may
still fail.
"""

from __future__ import annotations

import os
from pathlib import Path

from splatseed.errors import ParameterError

CGROUP = Path("/sys/fs/cgroup")
SUFFIXES = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def check_memory(count: int, bytes_each: int, what: str, *, found: str = "", fix: str) -> None:
    """Refuse what does not fit into the free memory.

    Args:
        count: How many things are wanted.
        bytes_each: What each takes.
        what: Their name.
        found: What was asked for, in words; the count when left out.
        fix: What the user can do; ``{most}`` in it becomes the number that fits.

    Raises:
        ParameterError: They do not fit.
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
    """An amount of memory such as 4G, 500M or a number of bytes.

    Raises:
        ParameterError: It is none.
    """
    plain = text.strip().upper().removesuffix("B").removesuffix("I")
    number, suffix = (plain[:-1], plain[-1]) if plain[-1:] in SUFFIXES else (plain, "")
    try:
        amount = float(number)
        known = 0 < amount < float("inf")
    except ValueError:
        known = False
    if not known:
        raise ParameterError(
            "an amount of memory such as 4G or 500M", found=repr(text), fix="Give such an amount."
        )
    return int(amount * SUFFIXES[suffix])


def words_of(amount: int, *, up: bool = False) -> str:
    """Bytes in words: tenths of GB, or whole MB.

    Args:
        amount: The bytes.
        up: Whether to round up.
    """
    unit, name, digits = (1 << 30, "GB", 1) if amount >= 1 << 30 else (1 << 20, "MB", 0)
    scaled = amount / unit * 10**digits
    rounded = (-int(-scaled // 1) if up else round(scaled)) / 10**digits
    return f"{rounded:,.{digits}f} {name}"


def option_of(amount: int) -> str:
    """The option that allows at least so many bytes, such as ``--memory 4.1G``."""
    return f"--memory {words_of(amount, up=True).replace(',', '')[:-1].replace(' ', '')}"


def free_memory() -> int | None:
    """Bytes that this process can still take; None where the system does not tell."""
    known = [free for free in (_of_machine(), _of_container()) if free is not None]
    return min(known, default=None)


def _of_machine() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text("ascii").splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith("MemAvailable:"))
        return int(kilobytes) * 1024
    except (OSError, StopIteration):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # not on Windows
        return None


def _of_container() -> int | None:
    """What a container's limit leaves; cached files count as free, as the system drops them."""
    try:
        limit = (CGROUP / "memory.max").read_text("ascii").strip()
        used = int((CGROUP / "memory.current").read_text("ascii"))
        lines = (CGROUP / "memory.stat").read_text("ascii").splitlines()
    except (OSError, ValueError):
        return None
    files = next((int(line.split()[1]) for line in lines if line.startswith("inactive_file ")), 0)
    return max(int(limit) - used + files, 0) if limit.isdigit() else None
