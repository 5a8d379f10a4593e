"""How large tiles may be, and what the work takes of memory and disk, before it begins.

Promise: a bound on memory holds for all processes of this machine together; what cannot be kept is
refused at once, with the number that is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from splatseed.errors import OutputError, ParameterError
from splatseed.process.memory import option_of, words_of
from splatseed.tiles.work import free_space
from splatseed.upsample.nearest import NearestMethod

PROCESS = 300 << 20
"""Memory of a process before it holds any points: libraries, compiled kernels, and their slack."""
PER_POINT, PER_NEIGHBOR, PER_NEW = 200, 20, 100
"""Bytes that a tile takes for each point, for each neighbour of each, and for each new point."""
MOST, LEAST = 1 << 20, 1 << 13
"""Larger tiles are no faster; smaller ones spend their time on their borders."""
WORTH = 4
"""Tiles of each process, from which on it is worth its start."""
AT_ONCE = 1 << 19
"""Rows of a pass over the disk."""
PER_ROW = 250
"""Bytes that such a pass takes for each of its rows."""


@dataclass(frozen=True)
class TilePlan:
    """What the work will take.

    Args:
        tile_points: Most points in a tile.
        at_once: Rows in memory at a time in passes over the disk.
        tiles: About how many tiles; None if the number of points is unknown.
        disk: Bytes on disk, the output included; None likewise.
        memory: Most bytes of memory.
    """

    tile_points: int
    at_once: int
    tiles: int | None
    disk: int | None
    memory: int

    @property
    def words(self) -> str:
        """A sentence for the user."""
        most = f"at most {words_of(self.memory)} of memory"
        if self.tiles is None or self.disk is None:
            return f"tiles of at most {self.tile_points:,} points, {most}"
        tiles = "1 tile" if self.tiles == 1 else f"about {self.tiles:,} tiles"
        return (
            f"{tiles} of at most {self.tile_points:,} points, {most},"
            f" {words_of(self.disk)} of disk while it works"
        )


def plan_tiles(
    method: object,
    count: int | None,
    num_new: int | None,
    memory: int,
    *,
    processes: int = 1,
    tile_points: int | None = None,
    held: int = 0,
) -> TilePlan:
    """Choose the size of tiles.

    Args:
        method: The method.
        count: Points of the cloud, if known.
        num_new: New points, if known.
        memory: Bytes that all processes may take together.
        processes: How many there are.
        tile_points: Most points in a tile, if the user says so.
        held: Bytes that the source keeps in memory all the while.

    Raises:
        ParameterError: The memory is not enough.
    """
    each, fixed = _costs(method, count, num_new, held)
    needed = processes * (PROCESS + LEAST * each) + fixed
    if memory < needed:
        raise ParameterError(
            f"at least {words_of(needed, up=True)} of memory for {processes} "
            f"process{'' if processes == 1 else 'es'}",
            found=words_of(memory),
            fix=f"Pass {option_of(needed)}" + (", or fewer --jobs." if processes > 2 else "."),
        )
    room = (memory - fixed) // processes - PROCESS
    most = min(tile_points or MOST, room // each)
    at_once = max(min(AT_ONCE, room // PER_ROW), LEAST)
    disk = None if count is None else _disk(method, count, num_new or 0)
    tiles = None if count is None else max(-(-count // most), 1)
    held = min(most, count or most)  # points of a tile
    peak = processes * PROCESS + max(processes * held * each, at_once * PER_ROW) + fixed
    return TilePlan(int(most), int(at_once), tiles, disk, min(int(peak), memory))


def choose_jobs(
    method: object,
    count: int | None,
    num_new: int | None,
    memory: int,
    *,
    cores: int,
    held: int = 0,
) -> int:
    """How many processes are to work on tiles, where the user leaves it open.

    One for each core, if each gets several tiles and the memory holds full ones for all: much of
    the work on a tile is done by one thread.

    Args:
        method: The method.
        count: Points of the cloud, if known.
        num_new: New points, if known.
        memory: Bytes that all processes may take together.
        cores: Most processes.
        held: Bytes that the source keeps in memory all the while.
    """
    if not isinstance(method, NearestMethod):
        return 1
    each, fixed = _costs(method, count, num_new, held)
    fits = (memory - fixed) // (PROCESS + MOST * each) - 1  # one is the process that hands out
    enough = cores if count is None else count // (WORTH * MOST)
    return max(1, min(cores, fits, enough))


def _costs(method: object, count: int | None, num_new: int | None, held: int) -> tuple[int, int]:
    """Bytes for each point of a tile, and for all tiles together."""
    neighbors = method.num_queried if isinstance(method, NearestMethod) else 0
    ratio = 4.0 if count is None or num_new is None else num_new / max(count, 1)
    each = int(PER_POINT + PER_NEIGHBOR * neighbors + PER_NEW * ratio)
    colors = 0 if isinstance(method, NearestMethod) else 3 * (count or 0)  # of method random
    return each, held + colors


def _disk(method: object, count: int, num_new: int) -> int:
    """Bytes at most on disk at a time: rows, tiles, what the draw needs, new points, output."""
    neighbors = method.num_neighbors if isinstance(method, NearestMethod) else 0
    made = num_new * 16 + count * 12
    at_work = count * (27 + 23 + 16 + 12 + 12 + 32 + 4 * neighbors) + made
    in_the_end = count * (27 + 8) + made + (count + num_new) * (27 + 43)
    return max(at_work, in_the_end)


def check_disk(path: Path, needed: int | None, there: int = 0) -> None:
    """Refuse a disk that is too small.

    Args:
        path: Where the work is to be done.
        needed: Bytes that it takes; None if unknown.
        there: Bytes of an earlier run, which count towards it.

    Raises:
        OutputError: There are fewer.
    """
    free = free_space(path)
    if needed is not None and needed - there > free:
        raise OutputError(
            f"{words_of(needed - there, up=True)} of free disk at {path.parent}",
            found=words_of(free),
            fix="Free some space, choose an output on a larger disk, or ask for fewer points.",
        )
