"""Files that hold a scene's points a second time, which another trainer may start from instead.

Somebody may have cleaned one of them. Promise: files whose points are those that are read, in any
order and as float32, are not mentioned.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatseed.errors import SplatseedError
from splatseed.io.files import open_file, read_file
from splatseed.io.ply import open_ply, read_ply
from splatseed.text import counted

_TOLERANCE = 1e-4
"""Of the points' extent: text and PLY files round positions."""
_USED_BY = {
    "points3D.ply": "graphdeco's trainer starts from it",
    "init.ply": "Brush starts from it",
    "pointcloud.ply": "LichtFeld Studio starts from it",
    "sparse_pc.ply": "nerfstudio starts from it if ply_file_path names it",
}


def count_points(path: Path) -> int | None:
    """How many points a file promises; None if it is damaged or no file of points."""
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
    """The first file that holds points, else the first; None without any."""
    if len(paths) > 1:
        # A damaged file is no empty one: it is read, and its error names it.
        return next((path for path in paths if count_points(path) != 0), paths[0])
    return next(iter(paths), None)


def differing_points_notes(
    read: Path, xyz: Float[np.ndarray, "N 3"], other: Path, use: str = ""
) -> list[str]:
    """A note on another file, if it holds other points than those that were read.

    ``use`` says what to do to have the other file read.
    """
    if not other.is_file() or not read.is_file() or other.samefile(read):
        return []
    count = count_points(other)
    if count == 0:
        return [f"{other} holds no points; {read.name} is read."] if len(xyz) else []
    if count is None or (count == len(xyz) and _same(other, xyz)):
        return []
    differ = f"{count:,}" if count != len(xyz) else f"{count:,} at other places"
    fate = _USED_BY.get(other.name, "is not used")
    way = f" To use it here, {use}." if use else ""
    used = f"{counted(len(xyz), 'point')} of {read.name} are used"
    return [f"{used}; {other.name}{_age(other, read)} has {differ}, and {fate}.{way}"]


def _same(path: Path, xyz: Float[np.ndarray, "N 3"]) -> bool:
    """Whether a file has the same positions; true of text, which is slow to read."""
    if path.suffix != ".ply" or not len(xyz):
        return True
    try:
        other = read_ply(path).xyz.astype(np.float64)
    except SplatseedError:
        return True  # its promise may be kept or not: another trainer will see
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    close = _TOLERANCE * float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0

    def near(a: np.ndarray, b: np.ndarray) -> bool:
        with np.errstate(invalid="ignore"):
            return bool(np.allclose(a, b, rtol=1e-5, atol=close, equal_nan=True))

    # In any order: one point that moved changes a sorted column.
    return near(other, xyz) or near(np.sort(other, axis=0), np.sort(xyz, axis=0))


def _age(other: Path, read: Path) -> str:
    """Which of two files is newer, if their times tell."""
    seconds = other.stat().st_mtime - read.stat().st_mtime
    newer = "newer" if seconds > 0 else "older"
    return "" if abs(seconds) < 1 else f", which is {newer},"
