"""Clouds of any size, merged into voxels while they are read: memory follows the photographs.

Notation: the *footprint* of a point is the side of a pixel at its depth, least over the views in
whose frames it falls. Its voxel has level L and side 2^(L + s), where 2^L is the greatest power of
two within the footprint, and s, at first 0, counts how often all voxels were made coarser. A voxel
holds the mean position and colour of its points, and their number. An even *sample* has voxels of
one side; its coordinates are relative to the file's first point.
Promise: the result depends on the points and their order, not on how they were cut into chunks nor
on the threads. Coordinates are float64 until they are in the scene's frame, so that those of
national grids lose nothing; memory holds one chunk and the voxels. Points that fall in no frame are
counted and dropped. When ``capacity`` voxels are filled, all are merged with their neighbours into
voxels of twice the side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int16, Int32, UInt8, UInt64

from splatseed.errors import ParameterError, PointCloudError
from splatseed.io.clouds import CloudChunk, CloudFile, open_cloud
from splatseed.photos.projection import cells_from_world
from splatseed.photos.view import View
from splatseed.progress import Progress
from splatseed.runtime.hashing import scramble
from splatseed.runtime.jit import inline, kernel, parallel_range
from splatseed.runtime.memory import free_memory, memory_argument, words_of
from splatseed.similarity import Similarity

BYTES_EACH = 320
"""Bytes per voxel, at most: 45 here, the others where voxels are looked at, thinned and written."""
CHUNKS, BLOCK = 64, 512
UNSEEN = -(1 << 15)
ASIDE = 0.381966
"""Where voxels begin along each axis: walls at round coordinates would lie on their sides, and
rounding put their points into either."""
FINEST = 20  # halvings of the first points' extent that make the first side of even voxels
LEAST_EXTENT = 1e-6
"""Least extent that is assumed of the first points: there may be one alone, such as a marker."""


class _Table(NamedTuple):
    """Voxels in the order in which they were first filled, and a hash table to find them."""

    keys: UInt64[np.ndarray, " C"]
    mean: Float32[np.ndarray, "C 3"]
    color: Float32[np.ndarray, "C 3"]
    counts: Int32[np.ndarray, " C"]
    level: Int16[np.ndarray, " C"]
    slots: Int32[np.ndarray, " S"]

    @classmethod
    def of(cls, capacity: int) -> _Table:
        """An empty one: pages of memory that are not written are not taken."""
        mean, color = np.empty((capacity, 3), np.float32), np.empty((capacity, 3), np.float32)
        count, level = np.empty(capacity, np.int32), np.empty(capacity, np.int16)
        slots = np.zeros(1 << (2 * capacity - 1).bit_length(), np.int32)
        return cls(np.empty(capacity, np.uint64), mean, color, count, level, slots)


class Voxels:
    """Points merged as they come, in voxels that all double in side when none is free.

    A side is so many ``pixels`` of the view that sees it most closely; without views all have one,
    the smallest that ``capacity`` allows. They grew ``coarser`` times; of ``total`` points,
    ``unseen`` fall in no frame.
    """

    def __init__(self, capacity: int, views: Sequence[View] = (), pixels: float = 2.0) -> None:
        self._capacity, self._num, self._table = capacity, 0, _Table.of(capacity)
        self._views, self._even = len(views), 0
        self.coarser = self.total = self.unseen = 0
        if views:
            matrices = np.stack([cells_from_world(view.camera, 1) for view in views])
            focals = [np.sqrt(abs(view.K[0, 0] * view.K[1, 1])) for view in views]
            self._matrices = matrices.astype(np.float32)
            self._sides = (pixels / np.array(focals)).astype(np.float32)
            self._sizes = np.array([[view.width, view.height] for view in views], np.float32)

    def __len__(self) -> int:
        return self._num

    @property
    def xyz(self) -> Float32[np.ndarray, "N 3"]:
        """Mean positions."""
        return self._table.mean[: self._num]

    @property
    def rgb(self) -> UInt8[np.ndarray, "N 3"]:
        """Mean colours."""
        return np.asarray(np.rint(self._table.color[: self._num]).astype(np.uint8))

    @property
    def count(self) -> Int32[np.ndarray, " N"]:
        """How many points each holds."""
        return self._table.counts[: self._num]

    @property
    def side(self) -> Float32[np.ndarray, " N"]:
        """The side of each, scene units."""
        return np.exp2(self._table.level[: self._num].astype(np.float32) + self.coarser)

    def add(
        self, xyz: Float64[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"] | None = None
    ) -> None:
        """Merge points, finite, in the world; without colours they count as black."""
        xyz, levels = np.ascontiguousarray(xyz), np.full(len(xyz), UNSEEN, np.int16)
        if self._views:
            _find_levels(xyz, self._matrices, self._sides, self._sizes, levels)
        else:
            if not self._num:
                extent = max(float(np.ptp(xyz, axis=0).max()), LEAST_EXTENT)
                self._even = int(np.floor(np.log2(extent))) - FINEST
            levels[:] = self._even
        colors = np.zeros((1, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
        self.total += len(xyz)
        self.unseen += int(np.count_nonzero(levels == UNSEEN))
        at = 0
        while at < len(xyz):
            at, num = _fill(at, xyz, colors, levels, self.coarser, *self._table, self._num)
            self._num = int(num)
            while at < len(xyz) and self._num == self._capacity:
                self.coarser += 1
                old, self._table = self._table, _Table.of(self._capacity)
                self._num = int(_merge(*old[1:5], self._num, self.coarser, *self._table))


@kernel
def _find_levels(xyz, matrices, sides, sizes, levels):  # type: ignore[no-untyped-def]  # Numba's types
    """The level of each point's footprint, from the view that sees it most closely."""
    for c in parallel_range(CHUNKS):
        block, least = np.empty((3, BLOCK), np.float32), np.empty(BLOCK, np.float32)
        stop = len(xyz) * (c + 1) // CHUNKS
        for start in range(len(xyz) * c // CHUNKS, stop, BLOCK):
            num = min(BLOCK, stop - start)
            for k in range(num):
                least[k] = np.float32(np.inf)
                for axis in range(3):
                    block[axis, k] = xyz[start + k, axis]
            for v in range(len(matrices)):
                _lessen(block, matrices[v], sides[v], sizes[v], least)
            for k in range(num):
                if least[k] < np.inf:
                    levels[start + k] = np.int16(np.floor(np.log2(least[k])))


@inline
def _lessen(block, m, side, size, least):  # type: ignore[no-untyped-def]  # Numba's types
    """Lower the least footprints of a block by one view's.

    Without branches or divisions, so that it is vectorised: u = (m x) / z is inside if 0 <= m x <
    width z, and the footprint is z / f times the pixels.
    """
    width, height, nothing = size[0], size[1], np.float32(np.inf)
    for k in range(BLOCK):
        x, y, z = block[0, k], block[1, k], block[2, k]
        column = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        row = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        across = (column >= 0) & (column < width * depth)
        inside = across & (row >= 0) & (row < height * depth) & (depth > 0)
        least[k] = min(least[k], depth * side if inside else nothing)


@inline
def _fill(start, xyz, rgb, levels, coarser, keys, mean, color, count, level, table, num):  # type: ignore[no-untyped-def]  # Numba's types
    """Merge points into voxels, one after another."""
    painted = len(rgb) == len(xyz)
    for i in range(start, len(xyz)):
        if levels[i] == UNSEEN:
            continue
        key = _key(xyz[i], levels[i], coarser)
        slot = _slot(key, keys, table)
        e = table[slot] - 1
        if e < 0:
            if num == len(keys):
                return i, num
            e = num
            num += 1
            table[slot], keys[e], level[e], count[e] = num, key, levels[i], 0
            for axis in range(3):
                mean[e, axis] = color[e, axis] = np.float32(0.0)
        count[e] += 1
        share = 1.0 / count[e]
        for axis in range(3):  # m <- m + (x - m) / n
            mean[e, axis] += (xyz[i, axis] - mean[e, axis]) * share
            if painted:
                color[e, axis] += (rgb[i, axis] - color[e, axis]) * share
    return len(xyz), num


@inline
def _merge(  # type: ignore[no-untyped-def]  # Numba's types
    mean, color, count, level, num, coarser, new_keys, new_mean, new_color, new_count, new_level,
    table,
):  # fmt: skip
    """Merge voxels into coarser ones, weighted by their points."""
    filled = 0
    for i in range(num):
        key = _key(mean[i], level[i], coarser)
        slot = _slot(key, new_keys, table)
        e = table[slot] - 1
        if e < 0:
            e = filled
            filled += 1
            table[slot], new_keys[e], new_level[e], new_count[e] = filled, key, level[i], 0
            for axis in range(3):
                new_mean[e, axis] = new_color[e, axis] = np.float32(0.0)
        new_count[e] += count[i]
        share = np.float64(count[i]) / new_count[e]
        for axis in range(3):
            new_mean[e, axis] += (mean[i, axis] - new_mean[e, axis]) * share
            new_color[e, axis] += (color[i, axis] - new_color[e, axis]) * share
    return filled


@inline
def _key(point, level, coarser):  # type: ignore[no-untyped-def]  # Numba's types
    """A 64-bit key for the voxel of a point; collisions are not to be expected."""
    per_side = np.exp2(-np.float64(level + coarser))
    key = scramble(np.uint64(np.int64(level) + 4096))
    for axis in range(3):
        key = scramble(key ^ np.uint64(np.int64(np.floor((point[axis] + ASIDE) * per_side))))
    return key


@inline
def _slot(key, keys, table):  # type: ignore[no-untyped-def]  # Numba's types
    """The slot of a key, or the free one where it belongs."""
    last = np.uint64(len(table) - 1)
    slot = key & last
    while table[slot] != 0 and keys[table[slot] - 1] != key:
        slot = (slot + np.uint64(1)) & last
    return slot


CHUNK = 1 << 19  # points in memory at a time: 50 MB with all that is computed of them
FEWEST, MOST = 1 << 16, 1 << 24  # least and greatest number of voxels
DEFAULT = 4 << 30  # most bytes of memory, unless the user says so
RESERVED = 700_000_000  # bytes for the program, its libraries and a chunk
PER_PIXEL = 8
"""Bytes for each pixel of the photographs: the pixel, grey as well, and what stereo knows of it."""
SAMPLE, LEAST_SAMPLE = 1 << 18, 1000  # most and fewest voxels of an even sample
TEXT_ROW = 40
"""Bytes of a line of text, to tell how far reading is where the number of lines is not known."""


class Streamed(NamedTuple):
    """What was read."""

    voxels: Voxels
    files: tuple[CloudFile, ...]
    bad: int  # points that are not finite
    low: Float64[np.ndarray, " 3"]  # least coordinates of the others in the scene's frame
    high: Float64[np.ndarray, " 3"]


class MemoryPlan(NamedTuple):
    """What seeds from a cloud will take."""

    capacity: int  # most voxels
    memory: int  # most bytes


def plan_memory(most: int | None, views: Sequence[View]) -> MemoryPlan:
    """How many voxels fit into ``most`` bytes of memory, beside photographs.

    ``DEFAULT`` when None; never more than is free.
    """
    free = free_memory()
    allowed = min(DEFAULT if most is None else most, free if free is not None else DEFAULT)
    fixed = RESERVED + PER_PIXEL * sum(view.width * view.height for view in views)
    needed = fixed + FEWEST * BYTES_EACH
    if allowed < needed:
        asked = most is not None and allowed == most
        raise ParameterError(
            f"at least {words_of(needed, up=True)} of memory for a cloud and {len(views):,} "
            "photographs",
            found=words_of(allowed) + ("" if asked else ", which are free"),
            fix=f"Pass {memory_argument(needed)}."
            if asked
            else "Free some, or use a larger machine.",
        )
    capacity = min((allowed - fixed) // BYTES_EACH, MOST)
    return MemoryPlan(capacity, fixed + capacity * BYTES_EACH)


def stream(
    paths: Sequence[Path],
    scene_from_cloud: Similarity | None,
    views: Sequence[View],
    pixels: float,
    capacity: int,
    progress: Progress,
) -> Streamed:
    """Read clouds of one frame into voxels of so many pixels of the views."""
    files = tuple(open_cloud(path) for path in paths)
    painted = all(file.colors != "none" for file in files)
    voxels = Voxels(capacity, views, pixels)
    low, high, bad = np.full(3, np.inf), np.full(3, -np.inf), 0
    for file in files:
        before, bad_before = voxels.total, bad
        for chunk, left_out in _finite_chunks(file, "read", progress):
            bad += left_out
            xyz = chunk.xyz if scene_from_cloud is None else scene_from_cloud.points(chunk.xyz)
            if len(xyz):
                low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
                voxels.add(xyz, chunk.rgb if painted else None)
        if voxels.total == before:
            raise PointCloudError(
                f"points with finite coordinates in {file.path}",
                found=f"{bad - bad_before:,} that are not finite" if bad > bad_before else "none",
                fix="Export the cloud again.",
            )
    return Streamed(voxels, files, bad, low, high)


def _finite_chunks(
    file: CloudFile, stage: str, progress: Progress
) -> Iterator[tuple[CloudChunk, int]]:
    """The finite points of a file, chunk by chunk, and how many others each had."""
    stage = f"{stage} {file.path.name}"
    progress(stage, 0.0)
    expected = file.count or max(file.path.stat().st_size // TEXT_ROW, 1)
    given = 0
    for chunk in file.chunks(CHUNK):
        given += len(chunk)
        finite = chunk.finite
        good = chunk if finite.all() else chunk.select(finite)
        yield good, len(chunk) - len(good)
        progress(stage, min(given / expected, 1.0))


def sample_cloud(
    paths: Sequence[Path], progress: Progress
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"] | None]:
    """An even sample of clouds of one frame: an offset, positions less it, and colours if known."""
    files = [open_cloud(path) for path in paths]
    painted = all(file.colors == "rgb" for file in files)
    voxels, offset = Voxels(SAMPLE), np.zeros(3)
    for file in files:
        for chunk, _ in _finite_chunks(file, "look at", progress):
            if len(chunk):
                offset = offset if len(voxels) else chunk.xyz[0].copy()
                voxels.add(chunk.xyz - offset, chunk.rgb if painted else None)
    if len(voxels) < LEAST_SAMPLE:
        raise PointCloudError(
            f"at least {LEAST_SAMPLE:,} points apart, to align a cloud by",
            found=f"{len(voxels):,}",
            fix="Give the transform with --transform FILE.",
        )
    return offset, voxels.xyz.astype(np.float64), voxels.rgb if painted else None
