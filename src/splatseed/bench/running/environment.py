"""The environment of a benchmark: machine, system, versions, and the command line."""

from __future__ import annotations

import os
import platform
import shlex
import socket
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("splatseed", "torch", "gsplat", "torchmetrics", "numpy", "scipy", "numba", "ray")


def describe_environment(words: Sequence[str]) -> dict[str, Any]:
    """The facts about a call of the command, as plain values.

    Args:
        words: What followed ``splatseed bench``.
    """
    return {
        "command": shlex.join(["splatseed", "bench", *words]),
        "folder": str(Path.cwd()),
        "host": socket.gethostname(),
        "system": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "memory_bytes": _memory(),
        "python": platform.python_version(),
        "versions": {name: version for name in PACKAGES if (version := package_version(name))},
    }


def package_version(package: str) -> str:
    """An installed package's version; empty if it is not installed or runs from its source."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _cpu() -> str:
    """The processor's name."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        for line in lines:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory() -> int | None:
    """Bytes of the machine's memory; None where the system does not tell."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # not on Windows
        return None
