"""Seeds that are made once for several runs: those of methods that use photographs.

Budgets and strategies thin the same points, which took a minute or more to make. Notation:
``BENCH/seeds/PRINT.npz`` holds points before thinning, and the seconds they took.
Promise: points are read back bit for bit; an unreadable file is ignored.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.bench.planning.records import RunSpec
from splatseed.errors import PointCloudError
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.staging import atomic_file
from splatseed.pointcloud import PointCloud

SEEDS = "seeds"


def made_file(bench: Path, spec: RunSpec) -> Path:
    """The file for the points that a run's method makes, before thinning.

    Args:
        bench: The benchmark's folder.
        spec: The run.
    """
    arm = spec.arm
    told = [spec.scene_digest, spec.depth_digest, arm.method, arm.profile, arm.ratio, spec.repeat,
            dict(spec.parameters), spec.version,
            *([spec.cloud_digest] if spec.cloud_digest else [])]  # fmt: skip
    text = json.dumps(told, sort_keys=True)
    return bench / SEEDS / f"{hashlib.blake2b(text.encode(), digest_size=16).hexdigest()}.npz"


def write_made(path: Path, cloud: PointCloud, seconds: float) -> None:
    """Store points and the seconds they took.

    Raises:
        OutputError: The file cannot be written.
    """
    arrays: dict[str, Any] = {"xyz": cloud.xyz, "rgb": cloud.rgb, "source": cloud.source}
    arrays |= cloud.attributes
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez(file, seconds=np.float64(seconds), **arrays)


def read_made(path: Path) -> tuple[PointCloud, float] | None:
    """The points that ``write_made`` stored; None if nothing can be read."""
    try:
        with np.load(path, allow_pickle=False) as kept:
            arrays = {name: kept[name] for name in kept.files}
            seconds = float(arrays.pop("seconds"))
            return PointCloud(**arrays), seconds
    except (*ARCHIVE_FAILURES, PointCloudError):
        return None
