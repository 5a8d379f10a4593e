"""Read clouds, chunk by chunk, into voxels.

Promise: coordinates are float64 until they are in the scene's frame, so that those of national
grids lose nothing; memory holds one chunk and the voxels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from splatseed.errors import PointCloudError
from splatseed.io.clouds import CloudChunk, CloudFile, open_cloud
from splatseed.photos.view import View
from splatseed.progress import Progress
from splatseed.seeding.clouds.voxels import Voxels
from splatseed.similarity import Similarity

CHUNK = 1 << 19  # points in memory at a time: 50 MB with all that is computed of them
TEXT_LINE = 40
"""Typical bytes of a line of text, for progress where the number of lines is not known."""
MIN_SAMPLE, MAX_SAMPLE = 1000, 1 << 18  # voxels of an even sample


class MergedCloud(NamedTuple):
    """Clouds merged in voxels."""

    voxels: Voxels
    files: tuple[CloudFile, ...]
    non_finite: int  # points that were left out
    low: Float64[np.ndarray, " 3"]  # corners of the bounding box, in the scene's frame
    high: Float64[np.ndarray, " 3"]


def read_clouds(
    paths: Sequence[Path],
    scene_from_cloud: Similarity | None,
    views: Sequence[View],
    pixels: float,
    capacity: int,
    progress: Progress,
    columns: Sequence[str] = (),
) -> MergedCloud:
    """Merge clouds, all in one frame, in voxels of so many pixels of the views."""
    files = tuple(open_cloud(path, columns) for path in paths)
    has_color = all(file.colors != "none" for file in files)
    voxels = Voxels(capacity, views, pixels)
    low, high, non_finite = np.full(3, np.inf), np.full(3, -np.inf), 0
    for file in files:
        before, non_finite_before = voxels.total, non_finite
        for chunk, left_out in _finite_chunks(file, "read", progress):
            non_finite += left_out
            xyz = chunk.xyz if scene_from_cloud is None else scene_from_cloud.points(chunk.xyz)
            if len(xyz):
                low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
                voxels.add(xyz, chunk.rgb if has_color else None)
        if voxels.total == before:
            num = non_finite - non_finite_before
            raise PointCloudError(
                f"points with finite coordinates in {file.path}",
                found=f"{num:,} that are not finite" if num else "none",
                fix="Export the cloud again.",
            )
    return MergedCloud(voxels, files, non_finite, low, high)


def _finite_chunks(
    file: CloudFile, stage: str, progress: Progress
) -> Iterator[tuple[CloudChunk, int]]:
    """Yield the finite points of each chunk, and the number of its others."""
    stage = f"{stage} {file.path.name}"
    progress(stage, 0.0)
    expected = file.count or max(file.path.stat().st_size // TEXT_LINE, 1)
    num_read = 0
    for chunk in file.chunks(CHUNK):
        num_read += len(chunk)
        finite = chunk.finite
        kept = chunk if finite.all() else chunk.select(finite)
        yield kept, len(chunk) - len(kept)
        progress(stage, min(num_read / expected, 1.0))


def sample_cloud(
    paths: Sequence[Path], progress: Progress, columns: Sequence[str] = ()
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"] | None]:
    """Sample clouds of one frame evenly.

    Returns an offset, the positions minus this offset, and the colours if all files have some.
    """
    files = [open_cloud(path, columns) for path in paths]
    has_color = all(file.colors == "rgb" for file in files)
    voxels, offset = Voxels(MAX_SAMPLE), np.zeros(3)
    for file in files:
        for chunk, _ in _finite_chunks(file, "sample", progress):
            if len(chunk):
                offset = offset if len(voxels) else chunk.xyz[0].copy()
                voxels.add(chunk.xyz - offset, chunk.rgb if has_color else None)
    if len(voxels) < MIN_SAMPLE:
        raise PointCloudError(
            f"at least {MIN_SAMPLE:,} distinct points, to align a cloud by",
            found=f"{len(voxels):,}",
            fix="Pass `transform`.",
        )
    return offset, voxels.xyz.astype(np.float64), voxels.rgb if has_color else None
