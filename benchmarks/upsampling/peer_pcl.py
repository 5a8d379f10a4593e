"""The peer: upsampling by the Point Cloud Library's moving least squares, in C++ on OpenMP.

Promise: the same originals, neighbourhoods of the same size (a ball whose radius is the median
distance to the 16th neighbour), a quadratic fit, as many threads as cores and about as many points
a base; only ``process()`` is timed, which builds its search tree as ``splatseed.upsample`` does.
PCL's points carry no colours here, ours do.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from splatseed import PointCloud
from splatseed.errors import MissingDependencyError
from splatseed.io.ply import write_ply

__all__ = ["MODES", "PeerTime", "build", "run"]

SOURCE = Path(__file__).parent / "pcl" / "mls_upsample.cpp"
MODES = ("random_uniform_density", "sample_local_plane")
PACKAGES = ("pcl_surface", "pcl_io")
NEIGHBORS = 16


@dataclass(frozen=True)
class PeerTime:
    """What one run of the peer gave."""

    num_points: int
    """Points in its output."""
    seconds: float
    """Wall time of ``process()``."""


def build(folder: Path) -> Path:
    """Compile the peer into ``folder``.

    Raises:
        MissingDependencyError: There is no compiler or no PCL on this machine.
    """
    compiler = shutil.which("c++")
    if compiler is None or shutil.which("pkg-config") is None:
        raise _absent("no C++ compiler or no pkg-config")
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", *PACKAGES], capture_output=True, text=True, check=False
    )
    if flags.returncode:
        raise _absent("no PCL that pkg-config knows of")
    program = folder / "mls_upsample"
    command = [compiler, "-O3", "-DNDEBUG", "-fopenmp", "-std=c++14", SOURCE]
    subprocess.run([*command, "-o", program, *flags.stdout.split()], check=True)
    return program


def _absent(found: str) -> MissingDependencyError:
    return MissingDependencyError(
        "PCL and a C++ compiler for the peer",
        found=found,
        fix="On Debian: apt-get install --no-install-recommends libpcl-dev g++ pkg-config.",
    )


def run(program: Path, cloud: PointCloud, mode: str, ratio: float, repeats: int) -> PeerTime:
    """The peer's best of ``repeats`` runs on a cloud.

    Args:
        program: From ``build``.
        cloud: The originals.
        mode: One of ``MODES``, PCL's ways to spread new points.
        ratio: Points in all per original that are aimed at; PCL hits it roughly.
        repeats: Runs, in one process.
    """
    radius = np.median(cKDTree(cloud.xyz).query(cloud.xyz, k=[NEIGHBORS + 1], workers=-1)[0])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.ply"
        write_ply(path, cloud)
        numbers = (radius, ratio, os.cpu_count() or 1, repeats)
        done = subprocess.run(
            [program, path, mode, *map(str, numbers)], check=True, capture_output=True, text=True
        )
    num_points, *seconds = done.stdout.split()
    return PeerTime(int(num_points), min(map(float, seconds)))
