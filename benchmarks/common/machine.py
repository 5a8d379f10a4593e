"""Describe the machine of a benchmark in one line."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path

__all__ = ["describe", "warn_if_busy"]

CPU_INFO = Path("/proc/cpuinfo")
PACKAGES = ("numpy", "scipy", "numba")
IDLE_LOAD = 0.5


def describe() -> str:
    """Return the processor, cores and versions."""
    libraries = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    return (
        f"{_processor()}, {os.cpu_count()} cores; Python {platform.python_version()}, {libraries}"
    )


def _processor() -> str:
    if CPU_INFO.exists():
        for line in CPU_INFO.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def warn_if_busy() -> None:
    """Warn if the machine is busy, which invalidates timings."""
    load = os.getloadavg()[0]
    if load > IDLE_LOAD:
        print(
            f"WARNING: the load average is {load:.1f}; times below are not those of an idle "
            "machine.\n"
        )
