"""Second step: the rows are sorted into tiles on disk, and what is not finite or repeats drops out.

Files of the step: ``tiles/NNNNNN`` holds the points of a tile by cell, in file order in each, with
their rows; ``tile_of_rank`` int32 [n] the tile of each point in file order; ``dropped`` int64 the
rows that were left out. Notation: n points are left; a point's *rank* is its place among them in
file order; the *cells* of a tile are ``CELLS`` along each side of its bounds, so that neighbouring
tiles read only what lies near them.
Promise: what is kept, its order and its centroid are those of the cloud in memory.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from splatseed.errors import ParameterError, PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks
from splatseed.tiles.cuts import Cuts, cut_up
from splatseed.tiles.reading import Rows
from splatseed.tiles.work import WorkFolder

RECORD = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("row", "<i8")])
"""A point of a tile."""
CELLS = 8
"""Cells along each side of a tile."""
MARGIN = 0.85
"""A sample tells the points of a tile only nearly."""
SMALLER = 0.7
TRIES = 8


def tile_name(tile: int) -> str:
    """The name of a tile's files."""
    return f"{tile:06d}"


def split(work: WorkFolder, most: int, at_once: int, progress: Progress) -> None:
    """Sort the rows into tiles.

    Args:
        work: The folder, in which the rows are read.
        most: Most points in a tile.
        at_once: Rows in memory at a time.
        progress: Told the stage.

    Raises:
        PointCloudError: No row is finite.
        ParameterError: More points than fit into memory lie so close that no cut divides them.
        OSError: The disk is full.
    """
    rows = Rows(work)
    cuts, non_finite = _assign(work, rows, most, at_once, progress)
    if non_finite == rows.count:
        raise PointCloudError(
            "at least one original point with finite coordinates",
            found=f"{rows.count} points, none of them finite and original",
            fix="Check that the scene holds the point cloud you meant.",
        )
    _distribute(work, rows, len(cuts), at_once, progress)
    bounds, starts = _without_repeats(work, len(cuts), progress)
    counts = starts[:, -1]
    center = _rank(work, rows, at_once, progress)
    n = int(counts.sum())
    arrays = {"walls": np.stack(cuts.walls), "bounds": bounds, "counts": counts, "starts": starts}
    work.save("layout", arrays)
    work.discard("tile_of_row")
    work.finish(
        "split",
        {
            "points": n,
            "most": max(most, int(counts.max())),
            "non_finite": non_finite,
            "repeats": rows.count - non_finite - n,
            "center": (center / n).tolist(),
        },
    )


def _assign(
    work: WorkFolder, rows: Rows, most: int, at_once: int, progress: Progress
) -> tuple[Cuts, int]:
    """Find cuts and note the tile of each row, -1 where it drops out; and count the non-finite."""
    sample = work.load("sample", "xyz")
    sample = sample[PointCloud(sample, np.zeros(sample.shape, np.uint8)).finite]
    wanted = MARGIN * most if len(sample) < rows.count else float(most)
    for _ in range(TRIES):
        cuts = cut_up(sample, rows.count, max(int(wanted), 1))
        counts, non_finite = _note_tiles(work, rows, cuts, at_once, progress)
        if counts.max(initial=0) <= max(most, -(-rows.count // at_once)):  # one of each piece
            return cuts, non_finite
        wanted *= SMALLER
    raise ParameterError(
        f"at most {most:,} points in each of the tiles, which the memory is enough for",
        found=f"{counts.max():,} points that are too close together to be cut apart",
        fix="Allow more with --memory.",
    )


def _note_tiles(
    work: WorkFolder, rows: Rows, cuts: Cuts, at_once: int, progress: Progress
) -> tuple[Int64[np.ndarray, " t"], int]:
    """Write ``tile_of_row``; returns the rows of each tile and how many are not finite."""
    counts, non_finite = np.zeros(len(cuts), np.int64), 0
    with work.partial("tile_of_row").open("wb") as file:
        for first, last in blocks(rows.count, at_once, "sort", progress):
            xyz = rows.xyz(first, last)
            cloud = PointCloud(xyz, np.zeros(xyz.shape, np.uint8))
            kept = cloud.distinct
            tiles = np.full(len(xyz), -1, np.int32)
            tiles[kept] = cuts.tiles_of(xyz[kept])
            non_finite += int(np.count_nonzero(~cloud.finite))
            counts += np.bincount(tiles[kept], minlength=len(cuts))
            file.write(tiles.data)
    work.complete("tile_of_row")
    return counts, non_finite


def _distribute(
    work: WorkFolder, rows: Rows, num_tiles: int, at_once: int, progress: Progress
) -> None:
    """Append each row to its tile's file."""
    folder = work.partial("tiles")
    folder.mkdir()
    for tile in range(num_tiles):
        (folder / tile_name(tile)).touch()
    for first, last in blocks(rows.count, at_once, "tiles", progress):
        tiles = _tile_of_row(work, first, last)
        kept = np.flatnonzero(tiles >= 0)
        records = np.empty(len(kept), RECORD)
        records["xyz"], records["rgb"] = rows.xyz(first, last)[kept], rows.rgb(first, last)[kept]
        records["row"] = first + kept
        for tile, places in by_tile(tiles[kept]):
            with (folder / tile_name(tile)).open("ab") as file:
                file.write(np.ascontiguousarray(records[places]).data)
    work.complete("tiles")


def by_tile(tiles: Int32[np.ndarray, " n"]) -> Iterator[tuple[int, Int64[np.ndarray, " m"]]]:
    """The tiles that occur in an array, each with its places there in order."""
    narrow = tiles.astype(np.uint16) if tiles.max(initial=0) < 1 << 16 else tiles
    order = np.argsort(narrow, kind="stable")  # a radix sort where 16 bits are enough
    counts = np.bincount(tiles)
    ends = np.cumsum(counts)
    for tile in np.flatnonzero(counts):
        yield int(tile), order[ends[tile] - counts[tile] : ends[tile]]


def _tile_of_row(work: WorkFolder, first: int, last: int) -> Int32[np.ndarray, " n"]:
    return np.fromfile(work.file("tile_of_row"), np.int32, last - first, offset=4 * first)


def _without_repeats(
    work: WorkFolder, num_tiles: int, progress: Progress
) -> tuple[Float32[np.ndarray, "t 2 3"], Int64[np.ndarray, "t c"]]:
    """Drop what repeats a position of an earlier piece, and sort the points of tiles by cell.

    Returns:
        The bounds of tiles; where in its file each cell of a tile begins, and the last one ends,
        int64 [t, CELLS^3 + 1].
    """
    bounds = np.full((num_tiles, 2, 3), np.nan, np.float32)
    starts = np.zeros((num_tiles, CELLS**3 + 1), np.int64)
    tile_of_row = np.memmap(work.file("tile_of_row"), np.int32, "r+")
    for tile, _ in blocks(num_tiles, 1, "tiles", progress):
        path = work.file("tiles") / tile_name(tile)
        records = np.fromfile(path, RECORD)
        kept = PointCloud(records["xyz"], records["rgb"]).distinct
        if not kept.all():
            tile_of_row[records["row"][~kept]] = -1
            records = records[kept]
        if len(records):
            bounds[tile] = records["xyz"].min(axis=0), records["xyz"].max(axis=0)
            x, y, z = cells_of(records["xyz"], bounds[tile]).T
            cell = ((x * CELLS + y) * CELLS + z).astype(np.uint16)
            starts[tile, 1:] = np.cumsum(np.bincount(cell, minlength=CELLS**3))
            records = records[np.argsort(cell, kind="stable")]  # a radix sort, of 16 bits
        records.tofile(work.partial("rest"))
        work.file("rest.partial").replace(path)
    tile_of_row.flush()
    return bounds, starts


def cells_of(
    xyz: Float32[np.ndarray, "n 3"], bounds: Float32[np.ndarray, "2 3"]
) -> Int64[np.ndarray, "n 3"]:
    """The cells of positions in a tile, along each axis; of those outside, the nearest.

    Rounding never swaps two positions, so what lies in a box lies in the cells of its corners or
    between them.
    """
    low, high = bounds.astype(np.float64)
    side = np.maximum((high - low) / CELLS, np.finfo(np.float32).tiny)
    cells = np.empty(xyz.shape, np.int64)
    for axis in range(3):  # column by column: NumPy is slow along short axes
        away = (xyz[:, axis] - low[axis]) / side[axis]
        cells[:, axis] = np.clip(away, 0, CELLS - 1)
    return cells


def _rank(
    work: WorkFolder, rows: Rows, at_once: int, progress: Progress
) -> Float64[np.ndarray, " 3"]:
    """Write ``tile_of_rank`` and ``dropped``; returns the sum of all positions, in file order."""
    total = np.zeros(3)
    with (
        work.partial("tile_of_rank").open("wb") as ranks,
        work.partial("dropped").open("wb") as dropped,
    ):
        for first, last in blocks(rows.count, at_once, "centre", progress):
            tiles = _tile_of_row(work, first, last)
            kept = tiles >= 0
            ranks.write(np.ascontiguousarray(tiles[kept]).data)
            dropped.write((first + np.flatnonzero(~kept)).astype("<i8").data)
            xyz = rows.xyz(first, last)[kept].astype(np.float64)
            # NumPy adds rows one after another, so the sum is that of all rows at once.
            total = np.concatenate([total[None], xyz]).sum(axis=0)
    for name in ("tile_of_rank", "dropped"):
        work.complete(name)
    return np.asarray(total)
