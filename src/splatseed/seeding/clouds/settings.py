"""Settings and inputs of the method ``cloud``, and how many voxels of a cloud fit into memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

from splatseed.errors import ParameterError
from splatseed.photos.view import View
from splatseed.runtime.memory import format_bytes, free_memory, memory_argument
from splatseed.settings import Range
from splatseed.similarity import Similarity


@dataclass(frozen=True)
class CloudSettings:
    """The options of the method."""

    pixels: Annotated[float, Range(0.25, 64)] = 2.0
    """Side of the voxels that merge points, in pixels of the closest photograph."""
    recolor: bool = False
    """Take colours from the photographs even if the cloud has some."""
    clean: bool = True
    """Leave out points that the photographs contradict, and isolated ones."""
    columns: tuple[str, ...] = ()
    """Columns of text clouds, such as x y z i r g b; _ skips one. By default the header's, or found
    from the values."""
    test_every: Annotated[int, Range(2, also=0)] = 0
    """Leave out every n-th image by name, as trainers do for testing (8); 0 = use all."""


class CloudInputs(NamedTuple):
    """The files of a call of the method."""

    paths: tuple[Path, ...]  # in one frame
    scene_from_cloud: Similarity | None
    capacity: int  # maximum number of voxels
    alone: bool  # whether no other method adds points; if so, a note may suggest one


@dataclass(frozen=True)
class _Memory:
    """What a cloud takes, in bytes."""

    default: int = 4 << 30
    """Limit, unless the user gives one."""
    reserved: int = 700_000_000
    """For the program, its libraries and a chunk."""
    per_pixel: int = 8
    """For each pixel of the photographs: its colour, its grey level, and stereo's maps."""
    per_voxel: int = 320
    """Upper bound: 49 in the table, the rest where voxels are checked, thinned and written."""
    min_voxels: int = 1 << 16
    max_voxels: int = 1 << 24


_MEMORY = _Memory()


class MemoryPlan(NamedTuple):
    """What seeds from a cloud will take."""

    capacity: int  # maximum number of voxels
    memory: int  # maximum bytes


def plan_memory(limit: int | None, views: Sequence[View]) -> MemoryPlan:
    """Compute how many voxels fit into ``limit`` bytes beside the photographs.

    The limit is 4 GB by default, and never more than the free memory.
    """
    free = free_memory()
    wanted = _MEMORY.default if limit is None else limit
    allowed = min(wanted, free if free is not None else _MEMORY.default)
    pixels = sum(view.width * view.height for view in views)
    fixed = _MEMORY.reserved + _MEMORY.per_pixel * pixels
    needed = fixed + _MEMORY.min_voxels * _MEMORY.per_voxel
    if allowed < needed:
        by_user = limit is not None and allowed == limit
        argument = f"Pass {memory_argument(needed)}."
        raise ParameterError(
            f"at least {format_bytes(needed, up=True)} of memory for a cloud and {len(views):,} "
            "photographs",
            found=format_bytes(allowed) + ("" if by_user else ", which are free"),
            fix=argument if by_user else "Free some, or use a larger machine.",
        )
    capacity = min((allowed - fixed) // _MEMORY.per_voxel, _MEMORY.max_voxels)
    return MemoryPlan(capacity, fixed + capacity * _MEMORY.per_voxel)
