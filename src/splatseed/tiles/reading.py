"""First step: a cloud is copied from its file to disk, as it is, in file order.

Notation: a *row* is a point as the file has it, also one that is not finite or repeats another.
Files of the step: ``xyz`` float64 [rows, 3], ``rgb`` uint8 [rows, 3] and ``trusted`` uint8 [rows]
if the scene has tracks. Promise: coordinates keep the precision of the input; nothing depends on
the size of the chunks.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from splatseed.io.clouds import CloudChunk
from splatseed.pointcloud import FARTHEST
from splatseed.progress import Progress
from splatseed.tiles.work import WorkFolder

GREY = 128
"""The colour of points without one."""
SAMPLE = 1 << 20
"""Rows that the first cuts are made by."""
FAR_OFF = 8.0
"""Coordinates farther from zero than this many extents of the cloud lose precision in float32."""
_HASH = np.uint64(0x9E3779B97F4A7C15)


class Frame:
    """What is learnt of coordinates on the way: bounds, and whether float32 holds them."""

    def __init__(self) -> None:
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.exact = True

    def add(self, xyz: Float64[np.ndarray, "n 3"]) -> None:
        """Take note of some rows."""
        finite = xyz[(np.abs(xyz) < FARTHEST).all(axis=1)]
        if len(finite):
            self.low = np.minimum(self.low, finite.min(axis=0))
            self.high = np.maximum(self.high, finite.max(axis=0))
            self.exact &= bool((finite == finite.astype(np.float32)).all())

    @property
    def origin(self) -> Float64[np.ndarray, " 3"]:
        """What is subtracted before coordinates become float32."""
        return origin_of(self.low, self.high, exact=self.exact)


def origin_of(
    low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], *, exact: bool
) -> Float64[np.ndarray, " 3"]:
    """The middle of the bounds in whole units where a cloud lies far off, as on a national grid.

    Zero where float32 holds the coordinates as they are, or where the cloud is near zero.

    Args:
        low: Least coordinates.
        high: Greatest coordinates.
        exact: Whether float32 holds them all.
    """
    far = max(float(np.abs(low).max()), float(np.abs(high).max()))
    if exact or not np.isfinite(far) or far <= FAR_OFF * float((high - low).max()):
        return np.zeros(3)
    return np.asarray(np.round((low + high) / 2))


def without_origin(
    xyz: Float64[np.ndarray, "n 3"], origin: Float64[np.ndarray, " 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Positions relative to the origin, as clouds hold them."""
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        return np.asarray((xyz - origin).astype(np.float32))


class _Sample:
    """An even choice of rows, of bounded size, that does not depend on how they come."""

    def __init__(self) -> None:
        self._limit = np.uint64(0xFFFFFFFFFFFFFFFF)
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, xyz: Float64[np.ndarray, "n 3"], first: int) -> None:
        hashed = np.arange(first, first + len(xyz), dtype=np.uint64) * _HASH  # modulo 2^64
        hashed ^= hashed >> np.uint64(32)
        hashed *= _HASH
        chosen = hashed <= self._limit
        self._rows.append((hashed[chosen], xyz[chosen]))
        while sum(len(each) for each, _ in self._rows) > 2 * SAMPLE:
            self._limit //= np.uint64(2)
            self._rows = [(h[h <= self._limit], x[h <= self._limit]) for h, x in self._rows]

    @property
    def xyz(self) -> Float64[np.ndarray, "s 3"]:
        return np.concatenate([np.empty((0, 3)), *(xyz for _, xyz in self._rows)])


def read_rows(
    work: WorkFolder,
    chunks: Iterable[CloudChunk],
    count: int | None,
    trusted: Bool[np.ndarray, " rows"] | None,
    progress: Progress,
) -> None:
    """Copy a cloud to disk.

    Args:
        work: The folder.
        chunks: The cloud.
        count: Rows that are expected, for the progress; None if unknown.
        trusted: Which rows may be bases; all when left out.
        progress: Told the stage.

    Raises:
        OSError: The disk is full.
    """
    frame, sample, rows = Frame(), _Sample(), 0
    with ExitStack() as files:
        xyz_file, rgb_file = (
            files.enter_context(work.partial(name).open("wb")) for name in ("xyz", "rgb")
        )
        for chunk in chunks:
            xyz = np.ascontiguousarray(chunk.xyz, "<f8")
            xyz_file.write(xyz.data)
            rgb_file.write(_colors(chunk).data)
            frame.add(xyz)
            sample.add(xyz, rows)
            rows += len(xyz)
            progress("read", rows / count if count else 0.0)
    for name in ("xyz", "rgb"):
        work.complete(name)
    if trusted is not None:
        trusted.astype(np.uint8).tofile(work.partial("trusted"))
        work.complete("trusted")
    work.save("sample", {"xyz": without_origin(sample.xyz, frame.origin)})
    work.finish("read", {"rows": rows, "origin": frame.origin.tolist()})


def _colors(chunk: CloudChunk) -> UInt8[np.ndarray, "n 3"]:
    if chunk.rgb is None:
        return np.full((len(chunk.xyz), 3), GREY, np.uint8)
    return np.ascontiguousarray(chunk.rgb)


class Rows:
    """The copied rows, read a piece at a time.

    Args:
        work: The folder, in which the first step is finished.
    """

    def __init__(self, work: WorkFolder) -> None:
        facts = work.facts("read") or {}
        self._work = work
        self.count = int(facts["rows"])
        self.origin: Float64[np.ndarray, " 3"] = np.array(facts["origin"], np.float64)

    def xyz(self, first: int, last: int) -> Float32[np.ndarray, "n 3"]:
        """Positions of rows, relative to the origin."""
        part = np.fromfile(
            self._work.file("xyz"), "<f8", 3 * (last - first), offset=24 * first
        ).reshape(-1, 3)
        return without_origin(part, self.origin)

    def rgb(self, first: int, last: int) -> UInt8[np.ndarray, "n 3"]:
        """Colours of rows."""
        part = np.fromfile(self._work.file("rgb"), np.uint8, 3 * (last - first), offset=3 * first)
        return part.reshape(-1, 3)

    def trusted(self, rows: np.ndarray) -> Bool[np.ndarray, " n"]:
        """Which of some rows may be bases."""
        path = self._work.file("trusted")
        if not path.is_file():
            return np.ones(len(rows), bool)
        known = np.memmap(path, np.uint8, "r")
        return np.asarray(known[rows] != 0)
