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
from splatseed.tiles.splitting import CELLS, RECORD, cells_of, tile_name
from splatseed.tiles.work import WorkFolder
from splatseed.upsample.neighbors import least_distance


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
    def _starts(self) -> Int64[np.ndarray, "t c"]:
        """Where in the file of a tile its cells begin."""
        return self.work.load("layout", "starts")

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
        path = self.work.file("tiles") / tile_name(tile)
        if within is None:
            records = np.fromfile(path, RECORD)
        else:
            box = self._in_file(within)
            records = self._near(np.memmap(path, RECORD, "r"), tile, box)
            records = records[_inside(records["xyz"], box)]
        row = records["row"]
        order = np.argsort(row, kind="stable")  # merges the cells, each of which is in file order
        records, row = records[order], row[order]
        xyz = records["xyz"].astype(np.float64) - self.center
        return Points(xyz, records["rgb"].copy(), self._ranks(row), self._rows.trusted(row))

    def _in_file(self, within: Float64[np.ndarray, "2 3"]) -> Float32[np.ndarray, "2 3"]:
        """A box in the coordinates of tiles' files, a little larger."""
        with np.errstate(over="ignore"):
            low, high = (within + self.center).astype(np.float32)
        away = np.float32(np.inf)
        return np.stack([np.nextafter(low, -away), np.nextafter(high, away)])

    def _near(self, records: np.ndarray, tile: int, box: Float32[np.ndarray, "2 3"]) -> np.ndarray:
        """The records of the cells that a box meets."""
        first, last = cells_of(box, self.extent[tile])
        starts = self._starts[tile]
        columns = [
            (x * CELLS + y) * CELLS
            for x in range(first[0], last[0] + 1)
            for y in range(first[1], last[1] + 1)
        ]  # a column of cells lies in the file as one piece
        return np.concatenate(
            [records[starts[c + first[2]] : starts[c + last[2] + 1]] for c in columns]
        )

    def _ranks(self, row: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        dropped = self._dropped
        return np.asarray(row - np.searchsorted(dropped, row)) if len(dropped) else row.copy()

    @property
    def _dropped(self) -> Int64[np.ndarray, " d"]:
        path = self.work.file("dropped")
        return np.memmap(path, "<i8", "r") if path.stat().st_size else np.empty(0, np.int64)


def _inside(
    xyz: Float32[np.ndarray, "n 3"], box: Float32[np.ndarray, "2 3"]
) -> Bool[np.ndarray, " n"]:
    """Which positions are in a box."""
    inside = np.ones(len(xyz), bool)
    for axis in range(3):  # column by column: NumPy is slow along short axes
        inside &= (xyz[:, axis] >= box[0, axis]) & (xyz[:, axis] <= box[1, axis])
    return inside
