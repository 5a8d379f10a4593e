"""Voxels of a pixel's size, filled while a cloud is read: memory follows the photographs, not it.

Notation: the *footprint* of a point is the side of a pixel at its depth, least over the views in
whose frames it falls. Its voxel has level L and side 2^(L + s), where 2^L is the greatest power of
two within the footprint, and s, at first 0, counts how often all voxels were made coarser. A voxel
holds the mean position and colour of its points, and their number.
Promise: the result depends on the points and their order, not on how they were cut into chunks nor
on the threads. Points that fall in no frame are counted and dropped. When ``capacity`` voxels are
filled, all are merged with their neighbours into voxels of twice the side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int16, Int32, UInt8

from splatseed.kernels.hashing import scramble
from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.seeding.coverage import grid_from_world
from splatseed.views.view import View

BYTES_EACH = 320
"""Bytes per voxel, at most: 45 here, the others where voxels are looked at, thinned and written."""
CHUNKS, BLOCK = 64, 512
UNSEEN = -(1 << 15)
ASIDE = 0.381966
"""Where voxels begin along each axis: walls at round coordinates would lie on their sides, and
rounding put their points into either."""
FINEST = 20
"""Halvings of the first points' extent that make the first side of even voxels."""


class _Growing:
    """Voxels that grow when they are all filled.

    Attributes:
        coarser: s, how often they did.
    """

    def __init__(self, capacity: int) -> None:
        self._entries = _Entries(capacity)
        self.coarser = 0

    def __len__(self) -> int:
        return self._entries.num

    @property
    def xyz(self) -> Float32[np.ndarray, "N 3"]:
        """Mean positions."""
        return self._entries.mean[: len(self)]

    @property
    def rgb(self) -> UInt8[np.ndarray, "N 3"]:
        """Mean colours."""
        return np.asarray(np.rint(self._entries.color[: len(self)]).astype(np.uint8))

    def _fill(
        self,
        xyz: Float64[np.ndarray, "n 3"],
        rgb: UInt8[np.ndarray, "n 3"],
        levels: Int16[np.ndarray, " n"],
    ) -> None:
        """Merge points into voxels, which grow when none is free."""
        at = 0
        while at < len(xyz):
            at = self._entries.fill(at, xyz, rgb, levels, self.coarser)
            while at < len(xyz) and self._entries.num == self._entries.capacity:
                self.coarser += 1
                self._entries = self._entries.merged(self.coarser)


class Voxels(_Growing):
    """Points merged as they come.

    Args:
        views: The views; only their cameras and sizes matter.
        pixels: Side of a voxel in pixels of the view that sees it most closely.
        capacity: Most voxels.

    Attributes:
        total: Points given.
        unseen: Of these, those that fall in no frame.
    """

    def __init__(self, views: Sequence[View], pixels: float, capacity: int) -> None:
        super().__init__(capacity)
        matrices = np.stack([grid_from_world(view, 1) for view in views])
        focals = [np.sqrt(abs(view.K[0, 0] * view.K[1, 1])) for view in views]
        self._matrices = matrices.astype(np.float32)
        self._sides = (pixels / np.array(focals)).astype(np.float32)
        self._sizes = np.array([[view.width, view.height] for view in views], np.float32)
        self.total = self.unseen = 0

    @property
    def count(self) -> Int32[np.ndarray, " N"]:
        """How many points each holds."""
        return self._entries.count[: len(self)]

    @property
    def side(self) -> Float32[np.ndarray, " N"]:
        """The side of each, scene units."""
        return np.exp2(self._entries.level[: len(self)].astype(np.float32) + self.coarser)

    def add(
        self, xyz: Float64[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"] | None = None
    ) -> None:
        """Merge points, finite, in the world; without colours they count as black."""
        levels = np.full(len(xyz), UNSEEN, np.int16)
        _find_levels(xyz, self._matrices, self._sides, self._sizes, levels)
        colors = np.zeros((1, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
        self.total += len(xyz)
        self.unseen += int(np.count_nonzero(levels == UNSEEN))
        self._fill(xyz, colors, levels)


class EvenVoxels(_Growing):
    """Points merged in voxels of one side, which doubles until ``capacity`` suffice."""

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity)
        self._level = 0

    @property
    def spacing(self) -> float:
        """The side of the voxels."""
        return float(np.exp2(float(self._level + self.coarser)))

    def add(
        self, xyz: Float64[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"] | None = None
    ) -> None:
        """Merge points, finite."""
        if not len(self):
            extent = max(float(np.ptp(xyz, axis=0).max()), float(np.finfo(np.float32).tiny))
            self._level = int(np.floor(np.log2(extent))) - FINEST
        levels = np.full(len(xyz), self._level, np.int16)
        colors = np.zeros((1, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
        self._fill(np.ascontiguousarray(xyz), colors, levels)


class _Entries:
    """Voxels in the order in which they were first filled, and a hash table to find them.

    Pages of memory that are not written are not taken: nothing is filled in advance.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity, self.num = capacity, 0
        self.keys = np.empty(capacity, np.uint64)
        self.mean = np.empty((capacity, 3), np.float32)
        self.color = np.empty((capacity, 3), np.float32)
        self.count = np.empty(capacity, np.int32)
        self.level = np.empty(capacity, np.int16)
        self.table = np.zeros(1 << (2 * capacity - 1).bit_length(), np.int32)

    def fill(
        self,
        start: int,
        xyz: Float64[np.ndarray, "n 3"],
        rgb: UInt8[np.ndarray, "n 3"],
        levels: Int16[np.ndarray, " n"],
        coarser: int,
    ) -> int:
        """Merge points from ``start`` on; returns the first for which no voxel was free."""
        at, num = _fill(
            start, xyz, rgb, levels, coarser, self.keys, self.mean, self.color, self.count,
            self.level, self.table, self.num,
        )  # fmt: skip
        self.num = int(num)
        return int(at)

    def merged(self, coarser: int) -> _Entries:
        """The same in voxels of a greater side."""
        new = _Entries(self.capacity)
        new.num = int(
            _merge(
                self.mean, self.color, self.count, self.level, self.num, coarser,
                new.keys, new.mean, new.color, new.count, new.level, new.table,
            )
        )  # fmt: skip
        return new


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
