"""The folder that a cloud is cut up in, and what the work takes of memory and disk.

Notation: a *step* is a pass over the whole cloud or the work on one tile; what it gives lies in
files or folders, and what it found in ``STEP.json``. Promise: these appear when they are complete,
so that a kill at any moment loses only the step that was running; the folder is used again only by
the command that began it, with the same input, and by one process at a time. A bound on memory
holds for all processes of this machine together; what cannot be kept is refused at once, with the
number that is needed.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from splatseed.errors import OutputError, ParameterError
from splatseed.io.files import read_text
from splatseed.io.staging import oserror_as_output_error, staged, write_json
from splatseed.literal import visible
from splatseed.runtime.memory import PROCESS, option_of, words_of
from splatseed.upsample.nearest import NearestMethod

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


def work_path(output: Path) -> Path:
    """The folder that an output is made in: beside it, so that it is on the same disk."""
    output = Path(output).absolute()
    return output.with_name(f"{output.name}.tiles")


@contextmanager
def open_work(path: Path, job: Mapping[str, object]) -> Iterator[bool]:
    """Hold the folder for a job while the block runs; yields whether earlier work is there.

    Args:
        path: Where it is, or is to be made.
        job: All that determines the result, as JSON has it.

    Raises:
        OutputError: It belongs to another job or to a process that is running, it is damaged, or it
            cannot be made.
    """
    with oserror_as_output_error(path):
        path.mkdir(parents=True, exist_ok=True)
        there = any(not each.name.startswith(".") for each in path.iterdir())
    known, asked = facts_of(path, "job"), json.loads(json.dumps(job))
    if there and not known:
        raise OutputError(
            f"no folder, or one with tiles, at {path}",
            found="a folder without job.json",
            fix="Remove it, or choose another output.",
        )
    try:
        with FileLock(path / ".lock", timeout=0):
            if not known:
                finish(path, "job", job)
                known = asked
            for name in sorted({*known, *asked}):
                if known.get(name) != asked.get(name):
                    old, new = (visible(json.dumps(e.get(name)))[:120] for e in (known, asked))
                    raise OutputError(
                        f"the same {name} as when {path} was begun ({old})",
                        found=new,
                        fix="Repeat the earlier command, or remove that folder to begin anew.",
                    )
            yield there
    except Timeout:
        raise OutputError(
            f"{path} to be free",
            found="another process at work there",
            fix="Wait for it to end, or stop it.",
        ) from None


def finish(work: Path, step: str, facts: Mapping[str, object]) -> None:
    """Note that a step is finished, and what it found."""
    write_json(work / f"{step}.json", facts)


def facts_of(work: Path, step: str) -> dict[str, Any]:
    """What a finished step found; nothing if it is not finished. A damaged note is refused."""
    path = work / f"{step}.json"
    if not path.is_file():
        return {}
    try:
        return dict(json.loads(read_text(path)))
    except (OSError, TypeError, ValueError):
        raise OutputError(
            f"{path} as an earlier run wrote it",
            found="a damaged file",
            fix=f"Remove the folder {work} to begin anew.",
        ) from None


def save_arrays(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Save arrays as a folder with a file each, which appears when it is complete."""
    with staged(folder, folder=True) as partial:
        for name, values in arrays.items():
            np.save(partial / f"{name}.npy", values, allow_pickle=False)


def load_arrays(folder: Path) -> dict[str, np.ndarray]:
    """The arrays of a folder by name, memory-mapped."""
    paths = sorted(folder.glob("*.npy"))
    return {path.stem: np.load(path, mmap_mode="r", allow_pickle=False) for path in paths}


@dataclass(frozen=True)
class TilePlan:
    """The size of tiles, and the memory and disk that the work needs."""

    tile_points: int  # at most, in a tile
    at_once: int  # rows in memory at a time in passes over the disk
    tiles: int | None  # about so many; None if the number of points is unknown
    disk: int | None  # bytes, those of the output included; None likewise
    memory: int  # bytes at most
    jobs: int = 1  # processes that work on tiles

    @property
    def words(self) -> str:
        """A sentence for the user."""
        most = f"of at most {self.tile_points:,} points, at most {words_of(self.memory)} of memory"
        if self.tiles is None or self.disk is None:
            return f"tiles {most}"
        tiles = "1 tile" if self.tiles == 1 else f"about {self.tiles:,} tiles"
        return f"{tiles} {most}, {words_of(self.disk)} of disk while it works"


def plan_tiles(
    method: object,
    count: int | None,
    num_new: int | None,
    memory: int,
    *,
    jobs: int | None = 1,
    cores: int = 1,
    tile_points: int | None = None,
    held: int = 0,
) -> TilePlan:
    """Choose the size of tiles, and refuse too little memory.

    Args:
        method: The method.
        count: Points of the cloud, if known.
        num_new: New points, if known.
        memory: Bytes that all processes may take together.
        jobs: Processes that work on tiles, beside the one that hands out unless it does so itself;
            None for one a core, ``cores`` at most, if each gets several full tiles.
        cores: See ``jobs``.
        tile_points: Most points in a tile, if the user says so.
        held: Bytes that the source keeps in memory all the while.
    """
    near = method if isinstance(method, NearestMethod) else None
    ratio = 4.0 if count is None or num_new is None else num_new / max(count, 1)
    each = int(PER_POINT + PER_NEIGHBOR * (near.num_queried if near else 0) + PER_NEW * ratio)
    fixed = held + (0 if near else 3 * (count or 0))  # method random holds all colours
    if jobs is None:
        fits = (memory - fixed) // (PROCESS + MOST * each) - 1
        enough = cores if count is None else count // (WORTH * MOST)
        jobs = max(1, min(cores, fits, enough)) if near else 1
    processes = jobs + (jobs > 1)
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
    full = min(most, count or most) * each
    peak = processes * PROCESS + max(processes * full, at_once * PER_ROW) + fixed
    tiles, disk = None, None
    if count is not None:
        tiles = 1 << max(-(-count // most) - 1, 0).bit_length()  # cut in half again and again
        neighbors, new = near.num_neighbors if near else 0, num_new or 0
        at_work = count * (31 + 24 + 16 + 12 + 32 + 4 * neighbors)  # rows, tiles, draw, neighbours
        for_repeats = count * (31 + 24 + 12 + 20) + new * 20
        in_the_end = count * 31 + (count + new) * (27 + 43)
        disk = max(at_work, for_repeats, in_the_end) + new * 24
    return TilePlan(int(most), int(at_once), tiles, disk, min(int(peak), memory), jobs)


def check_disk(path: Path, needed: int | None) -> None:
    """Refuse a disk that is too small; what an earlier run left in the folder counts as free."""
    there = sum(each.stat().st_size for each in path.rglob("*") if each.is_file())
    free = there + shutil.disk_usage(next(each for each in path.parents if each.exists())).free
    if needed is not None and needed > free:
        raise OutputError(
            f"{words_of(needed, up=True)} of free disk at {path.parent}",
            found=words_of(free),
            fix="Free some space, choose an output on a larger disk, or ask for fewer points.",
        )
