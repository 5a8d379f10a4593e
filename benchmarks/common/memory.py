"""Peak memory: of one upsampling in a process of its own, and of a process with its descendants.

Promise, of the first: the child loads the input, warms the method up on a small cloud, then notes
its resident memory; the result is how far the peak of the one large run rises above that, so that
the interpreter, the libraries, compiled code and the input itself do not count; the output does.

The kernel's own high-water mark is reset before the run and read after it (Linux). The peak of
``resource.getrusage`` cannot be reset, and a child's begins at its parent's.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Self

import numpy as np

import splatseed as ss

__all__ = ["FamilyWatch", "family_seconds", "peak_bytes_per_output", "reset_peak", "status_bytes"]

PROCESSES = Path("/proc")
STATUS = PROCESSES / "self/status"
RESET = PROCESSES / "self/clear_refs"
RESET_PEAK = "5"
WARM_UP_POINTS = 2_000
SAMPLE_SECONDS = 0.1


def peak_bytes_per_output(cloud: ss.PointCloud, ratio: float, method: dict[str, Any]) -> float:
    """Peak bytes above the warmed process per output point (originals included); NaN off Linux.

    Args:
        cloud: The originals.
        ratio: Points in all per original.
        method: Keyword arguments of ``splatseed.upsample``: the method and its parameters.
    """
    if not RESET.exists():
        return float("nan")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.npz"
        np.savez(path, xyz=cloud.xyz, rgb=cloud.rgb)
        job = json.dumps({"path": str(path), "options": {**method, "ratio": ratio}})
        done = subprocess.run(
            [sys.executable, __file__, job], check=True, capture_output=True, text=True
        )
    return float(done.stdout)


def _measure(path: str, options: dict[str, Any]) -> float:
    with np.load(path) as arrays:
        cloud = ss.PointCloud(arrays["xyz"], arrays["rgb"])
    ss.upsample(cloud.select(slice(WARM_UP_POINTS)), **options)
    reset_peak()
    before = status_bytes("VmRSS")
    seeds = ss.upsample(cloud, **options)
    return (status_bytes("VmHWM") - before) / len(seeds)


def reset_peak() -> None:
    """Let this process' high-water mark of memory (VmHWM) start again; nothing off Linux."""
    if RESET.exists():
        RESET.write_text(RESET_PEAK, encoding="ascii")


def status_bytes(field: str) -> int:
    """Memory of this process by one of the kernel's names; -1 off Linux."""
    if not STATUS.exists():
        return -1
    line = next(row for row in STATUS.read_text("ascii").splitlines() if row.startswith(field))
    return 1024 * int(line.split()[1])


class FamilyWatch:
    """Notes the most memory that a process and its descendants hold at a time, while a block runs.

    Ten times a second it adds up what is resident. Pages that several of them share count several
    times, as do pages of mapped files, which the system may drop. The high-water marks of
    ``resource.getrusage`` do not serve: a child's begins at its parent's.

    Args:
        pid: The process.
    """

    def __init__(self, pid: int) -> None:
        self.peak = 0
        """Bytes; 0 off Linux."""
        self._pid = pid
        self._over = Event()
        self._thread = Thread(target=self._sample, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()

    def _sample(self) -> None:
        while not self._over.wait(SAMPLE_SECONDS):
            self.peak = max(self.peak, sum(map(_resident, _family(self._pid))))


def _family(pid: int) -> Iterator[int]:
    """A process and its descendants, as far as they run."""
    yield pid
    for task in (PROCESSES / str(pid) / "task").glob("*/children"):
        with suppress(OSError):  # it has just ended
            for child in task.read_text("ascii").split():
                yield from _family(int(child))


def family_seconds(pid: int) -> float:
    """CPU seconds of a process and its descendants so far, those that have ended included."""
    ticks = 0
    for each in _family(pid):
        with suppress(OSError, IndexError):  # it has just ended, and is its parent's
            # After the name, which may hold spaces: own and ended children's, user and system.
            fields = (PROCESSES / str(each) / "stat").read_text("utf-8", "replace")
            ticks += sum(map(int, fields.rpartition(")")[2].split()[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> int:
    with suppress(OSError):
        for row in (PROCESSES / str(pid) / "status").read_text("ascii", "replace").splitlines():
            if row.startswith("VmRSS:"):
                return 1024 * int(row.split()[1])
    return 0  # it has just ended


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(_measure(given["path"], given["options"]))
