"""Voxels: clouds of any size, merged while they are read, so that memory follows the photographs.

Notation: the *footprint* of a point is the side of a pixel at its depth, smallest over the views in
whose frames it falls. Its voxel has level L and side 2^(L + s), where 2^L is the greatest power of
two within the footprint, and s, the *coarsening*, counts how often all voxels were doubled. A voxel
holds the mean position of its points, their number, and the mean colour of those that are not
black, as scanners store where they saw none. Without views all voxels have one side.
Promise: the result depends on the points and their order, neither on how they were cut into chunks
nor on the number of threads. Points in no frame are counted and dropped. When ``capacity`` voxels
are filled, all are merged with their neighbours into voxels of twice the side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from splatseed.photos.view import View
from splatseed.seeding.clouds._kernels import (
    OUTSIDE,
    VoxelTable,
    find_levels,
    merge_points,
    merge_voxels,
)

MAX_HALVINGS = 20  # of the first points' extent, down to the first side of voxels without views
MIN_EXTENT = 1e-6
"""Minimum extent assumed of the first points: there may be a single one, such as a marker."""


def _empty_table(capacity: int) -> VoxelTable:
    """Return an empty table; pages that are not written take no memory."""
    mean, color = np.empty((capacity, 3), np.float32), np.empty((capacity, 3), np.float32)
    counts, num_colored = np.empty(capacity, np.int32), np.empty(capacity, np.int32)
    level = np.empty(capacity, np.int16)
    slots = np.zeros(1 << (2 * capacity - 1).bit_length(), np.int32)
    return VoxelTable(np.empty(capacity, np.uint64), mean, color, counts, num_colored, level, slots)


class Voxels:
    """Points merged in voxels, which all double in side when none is free.

    Args:
        capacity: Maximum number of voxels.
        views: A voxel's side follows the view that sees it most closely. Without views all sides
            are equal, the smallest that ``capacity`` allows.
        pixels: Side of a voxel in pixels of that view.

    Attributes:
        coarsening: How often the sides were doubled.
        total: Points added.
        num_outside: Points among them that are in no frame.
    """

    def __init__(self, capacity: int, views: Sequence[View] = (), pixels: float = 2.0) -> None:
        self._capacity, self._num, self._table = capacity, 0, _empty_table(capacity)
        self._has_views, self._level = bool(views), 0
        self.coarsening = self.total = self.num_outside = 0
        if views:
            matrices = np.stack([view.camera.pixels_from_world for view in views])
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
        """Mean colours of the points that have one; black without any."""
        return np.asarray(np.rint(self._table.color[: self._num]).astype(np.uint8))

    @property
    def has_color(self) -> Bool[np.ndarray, " N"]:
        """Whether any point of a voxel has a colour."""
        return np.asarray(self._table.num_colored[: self._num] > 0)

    @property
    def count(self) -> Int32[np.ndarray, " N"]:
        """Points in each voxel."""
        return self._table.counts[: self._num]

    @property
    def side(self) -> Float32[np.ndarray, " N"]:
        """Side of each voxel, scene units."""
        return np.exp2(self._table.level[: self._num].astype(np.float32) + self.coarsening)

    def add(
        self, xyz: Float64[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"] | None = None
    ) -> None:
        """Merge finite points of the world; without colours they are black."""
        xyz, levels = np.ascontiguousarray(xyz), np.full(len(xyz), OUTSIDE, np.int16)
        if self._has_views:
            find_levels(xyz, self._matrices, self._sides, self._sizes, levels)
        else:
            if not self._num:
                extent = max(float(np.ptp(xyz, axis=0).max()), MIN_EXTENT)
                self._level = int(np.floor(np.log2(extent))) - MAX_HALVINGS
            levels[:] = self._level
        colors = np.zeros((1, 3), np.uint8) if rgb is None else np.ascontiguousarray(rgb)
        self.total += len(xyz)
        self.num_outside += int(np.count_nonzero(levels == OUTSIDE))
        start = 0
        while start < len(xyz):
            start, num = merge_points(
                start, xyz, colors, levels, self.coarsening, self._table, self._num
            )
            self._num = int(num)
            while start < len(xyz) and self._num == self._capacity:
                self.coarsening += 1
                old, self._table = self._table, _empty_table(self._capacity)
                num = merge_voxels(old, self._num, self.coarsening, self._table)
                self._num = int(num)
