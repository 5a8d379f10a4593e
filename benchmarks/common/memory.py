"""Peak memory of one upsampling, measured in a process of its own.

Promise: the child loads the input, warms the method up on a small cloud, then notes its resident
memory; the result is how far the peak of the one large run rises above that, so that the
interpreter, the libraries, compiled code and the input itself do not count; the output does.

The kernel's own high-water mark is reset before the run and read after it (Linux). The peak of
``resource.getrusage`` cannot be reset, and a child's begins at its parent's.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import splatseed as ss

__all__ = ["peak_bytes_per_output", "status_bytes"]

STATUS = Path("/proc/self/status")
RESET = Path("/proc/self/clear_refs")
RESET_PEAK = "5"
WARM_UP_POINTS = 2_000


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
    RESET.write_text(RESET_PEAK, encoding="ascii")
    before = status_bytes("VmRSS")
    seeds = ss.upsample(cloud, **options)
    return (status_bytes("VmHWM") - before) / len(seeds)


def status_bytes(field: str) -> int:
    """Memory of this process by one of the kernel's names; -1 off Linux."""
    if not STATUS.exists():
        return -1
    line = next(row for row in STATUS.read_text("ascii").splitlines() if row.startswith(field))
    return 1024 * int(line.split()[1])


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(_measure(given["path"], given["options"]))
