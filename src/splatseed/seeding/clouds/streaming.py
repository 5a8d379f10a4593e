"""Reading clouds into voxels: files in chunks, through a transform, into the scene's frame.

Promise: coordinates are float64 until they are in the scene's frame, so that those of national
grids lose nothing; memory holds one chunk and the voxels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.errors import ParameterError, PointCloudError
from splatseed.io.clouds import CloudChunk, CloudFile, open_cloud
from splatseed.process.memory import free_memory, option_of, words_of
from splatseed.progress import Progress
from splatseed.seeding.clouds.voxels import BYTES_EACH, Voxels
from splatseed.similarity import Similarity
from splatseed.views.view import View

CHUNK = 1 << 19
"""Points in memory at a time: 50 MB with all that is computed of them."""
FEWEST, MOST = 1 << 16, 1 << 24
"""Least and greatest number of voxels."""
DEFAULT = 4 << 30
"""Most bytes of memory, unless the user says so."""
RESERVED = 700_000_000
"""Bytes for the program, its libraries and a chunk."""
PER_PIXEL = 8
"""Bytes for each pixel of the photographs: the pixel, grey as well, and what stereo knows of it."""
TEXT_ROW = 40
"""Bytes of a line of text, to tell how far reading is where the number of lines is not known."""


@dataclass(frozen=True, eq=False)
class Streamed:
    """What was read.

    Args:
        voxels: The points, merged.
        files: The files.
        bad: Points that are not finite.
        low: Least coordinates of the others in the scene's frame, float64 [3].
        high: Greatest.
    """

    voxels: Voxels
    files: tuple[CloudFile, ...]
    bad: int
    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]


@dataclass(frozen=True)
class MemoryPlan:
    """What seeds from a cloud will take.

    Args:
        capacity: Most voxels.
        memory: Most bytes.
    """

    capacity: int
    memory: int


def plan_memory(most: int | None, views: Sequence[View]) -> MemoryPlan:
    """How many voxels fit into memory, beside photographs.

    Args:
        most: Most bytes; ``DEFAULT`` when None. Never more than is free.
        views: The views.

    Raises:
        ParameterError: The program, the photographs and the fewest voxels do not fit.
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
            fix=f"Pass {option_of(needed)}." if asked else "Free some, or use a larger machine.",
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
    """Read clouds into voxels.

    Args:
        paths: The files.
        scene_from_cloud: From their frame to the scene's; the same frame when None.
        views: The views that determine the voxels' sides.
        pixels: Side of a voxel in pixels.
        capacity: Most voxels.
        progress: Told how far it is.

    Raises:
        SceneNotFoundError: A file is missing.
        SceneFormatError: One is damaged.
        PointCloudError: One holds no finite point.
    """
    files = tuple(open_cloud(path) for path in paths)
    painted = all(file.colors != "none" for file in files)
    voxels = Voxels(views, pixels, capacity)
    low, high, bad = np.full(3, np.inf), np.full(3, -np.inf), 0
    for file in files:
        before = voxels.total
        for done, chunk in _read(file, progress):
            finite = chunk.finite
            bad += len(chunk) - int(np.count_nonzero(finite))
            good = chunk if finite.all() else chunk.select(finite)
            xyz = good.xyz if scene_from_cloud is None else scene_from_cloud.points(good.xyz)
            if len(xyz):
                low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
                voxels.add(np.ascontiguousarray(xyz), good.rgb if painted else None)
            progress(f"read {file.path.name}", done)
        if voxels.total == before:
            raise PointCloudError(
                f"points with finite coordinates in {file.path}",
                found=f"{bad:,} that are not finite" if bad else "none",
                fix="Export the cloud again.",
            )
    return Streamed(voxels, files, bad, low, high)


def _read(file: CloudFile, progress: Progress) -> Iterator[tuple[float, CloudChunk]]:
    """The chunks of a file, each with the share that is then read."""
    progress(f"read {file.path.name}", 0.0)
    expected = file.count or max(file.path.stat().st_size // TEXT_ROW, 1)
    given = 0
    for chunk in file.chunks(CHUNK):
        given += len(chunk)
        yield min(given / expected, 1.0), chunk
