"""The tiles on disk, read one at a time.

Notation: *position* is a point's place in its tile, in file order; *rank* its place among all n
points in file order; coordinates are float64 relative to the centroid, as the methods take them.
Promise: what is read here equals what ``upsample.neighbors.prepare`` makes of the cloud in memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.tiles.reading import Rows
from splatseed.tiles.splitting import RECORD, tile_name
from splatseed.tiles.work import WorkFolder
from splatseed.upsample.neighbors import least_distance

__all__ = ["Points", "TileStore"]


@dataclass(frozen=True, eq=False)
class Points:
    """Some points, in file order.

    Args:
        xyz: Positions relative to the centroid, float64 [n, 3].
        rgb: Colours, uint8 [n, 3].
        rank: Ranks, ascending, int64 [n].
        trusted: Which may be bases, bool [n].
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]
    rank: Int64[np.ndarray, " n"]
    trusted: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, which: np.ndarray) -> Points:
        """The points at ``which``, in that order."""
        return Points(self.xyz[which], self.rgb[which], self.rank[which], self.trusted[which])

    @staticmethod
    def union(parts: list[Points]) -> Points:
        """All points of the parts once, by rank."""
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("xyz", "rgb", "rank", "trusted")
        }
        _, first = np.unique(arrays["rank"], return_index=True)
        return Points(**{name: values[first] for name, values in arrays.items()})


class TileStore:
    """The tiles of a cloud.

    Args:
        work: The folder, in which the rows are split.
    """

    def __init__(self, work: WorkFolder) -> None:
        self.work = work
        facts = work.facts("split") or {}
        self.count = int(facts["points"])
        self.center: Float64[np.ndarray, " 3"] = np.array(facts["center"], np.float64)
        self.counts: Int64[np.ndarray, " t"] = work.load("layout", "counts")
        self._rows = Rows(work)

    def __len__(self) -> int:
        """The number of tiles."""
        return len(self.counts)

    @cached_property
    def walls(self) -> Float64[np.ndarray, "t 2 3"]:
        """The boxes that space is divided into, some of them without end, [t, 2, 3]."""
        return np.asarray(self.work.load("layout", "walls").astype(np.float64) - self.center)

    @cached_property
    def extent(self) -> Float32[np.ndarray, "t 2 3"]:
        """Bounds of each tile's points relative to the origin; NaN where it has none, [t, 2, 3]."""
        return self.work.load("layout", "bounds")

    @cached_property
    def bounds(self) -> Float64[np.ndarray, "t 2 3"]:
        """The same relative to the centroid."""
        return np.asarray(self.extent.astype(np.float64) - self.center)

    @cached_property
    def least(self) -> float:
        """The least distance of two points."""
        return least_distance(float(np.nanmax(np.abs(self.bounds))))

    def points(self, tile: int, within: Float64[np.ndarray, "2 3"] | None = None) -> Points:
        """The points of a tile.

        Args:
            tile: Its number.
            within: Only those in this box, relative to the centroid; all when left out.
        """
        records = np.fromfile(self.work.file("tiles") / tile_name(tile), RECORD)
        if within is not None:
            records = records[self._inside(records["xyz"], within)]
        xyz = records["xyz"].astype(np.float64) - self.center
        row = records["row"]
        return Points(xyz, records["rgb"].copy(), self._ranks(row), self._rows.trusted(row))

    def _inside(
        self, xyz: Float32[np.ndarray, "n 3"], within: Float64[np.ndarray, "2 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Which positions are in a box, and perhaps some just outside."""
        with np.errstate(over="ignore"):
            low, high = (within + self.center).astype(np.float32)
        low, high = np.nextafter(low, np.float32(-np.inf)), np.nextafter(high, np.float32(np.inf))
        inside = np.ones(len(xyz), bool)
        for axis in range(3):  # column by column: NumPy is slow along short axes
            inside &= (xyz[:, axis] >= low[axis]) & (xyz[:, axis] <= high[axis])
        return inside

    def _ranks(self, row: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        dropped = self._dropped
        return np.asarray(row - np.searchsorted(dropped, row)) if len(dropped) else row.copy()

    @property
    def _dropped(self) -> Int64[np.ndarray, " d"]:
        path = self.work.file("dropped")
        return np.memmap(path, "<i8", "r") if path.stat().st_size else np.empty(0, np.int64)
