"""Find other point files of a scene, with different points, from which other trainers would start.

For example, the user may have cleaned one of them. Files with the same float32 points in any order
are not reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.io.files import open_file, read_file
from splatseed.io.ply import open_ply, read_ply
from splatseed.text import counted

_KIND = "differing-points"  # of findings
_TOLERANCE = 1e-4
"""Tolerance as a share of the points' extent: text and PLY files round positions."""
_USED_BY = {
    "points3D.ply": "graphdeco's trainer starts from it",
    "init.ply": "Brush starts from it",
    "pointcloud.ply": "LichtFeld Studio starts from it",
    "sparse_pc.ply": "nerfstudio starts from it if ply_file_path names it",
}


def count_points(path: Path) -> int | None:
    """Read the number of points of a file; None if damaged or no point file."""
    with suppress(SplatseedError, OSError):
        if path.suffix == ".ply":
            return open_ply(path).count
        if path.suffix == ".bin":
            with open_file(path) as file:
                head = file.read(8)
            return int.from_bytes(head, "little") if len(head) == 8 else None
        lines = (line.lstrip() for line in read_file(path).splitlines())
        return sum(bool(line) and not line.startswith(b"#") for line in lines)
    return None


def first_with_points(paths: Sequence[Path]) -> Path | None:
    """Return the first file with points, else the first file; None without any."""
    if len(paths) > 1:
        # A damaged file (count None) is chosen, so that reading it reports the error.
        return next((path for path in paths if count_points(path) != 0), paths[0])
    return next(iter(paths), None)


def differing_points(
    read: Path, xyz: Float[np.ndarray, "N 3"], other: Path, use: str = ""
) -> list[Finding]:
    """Report another point file if its points differ from the positions ``xyz`` of the one read.

    ``use`` says how to have the other file read, such as "move A out of B".
    """
    if not other.is_file() or not read.is_file() or other.samefile(read):
        return []
    count = count_points(other)
    if count == 0:
        text = f"{other} holds no points; {read.name} is read."
        return [Finding(_KIND, text)] if len(xyz) else []
    if count is None or (count == len(xyz) and _same(other, xyz)):
        return []
    differ = f"{count:,}" if count != len(xyz) else f"{count:,} at other positions"
    effect = _USED_BY.get(other.name, "is not used")
    advice = f" To use it here, {use}." if use else ""
    used = f"{counted(len(xyz), 'point')} of {read.name} are used"
    text = f"{used}; {other.name}{_age(other, read)} has {differ}, and {effect}.{advice}"
    return [Finding(_KIND, text)]


def _same(path: Path, xyz: Float[np.ndarray, "N 3"]) -> bool:
    """Whether a file has the same positions; assumed for text, which is slow to read."""
    if path.suffix != ".ply" or not len(xyz):
        return True
    try:
        other = read_ply(path).xyz.astype(np.float64)
    except SplatseedError:
        return True  # damaged: nothing to compare
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    close = _TOLERANCE * float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0

    def near(a: np.ndarray, b: np.ndarray) -> bool:
        with np.errstate(invalid="ignore"):
            return bool(np.allclose(a, b, rtol=1e-5, atol=close, equal_nan=True))

    # Compare sorted columns, since the order may differ.
    return near(other, xyz) or near(np.sort(other, axis=0), np.sort(xyz, axis=0))


def _age(other: Path, read: Path) -> str:
    seconds = other.stat().st_mtime - read.stat().st_mtime
    newer = "newer" if seconds > 0 else "older"
    return "" if abs(seconds) < 1 else f", which is {newer},"
