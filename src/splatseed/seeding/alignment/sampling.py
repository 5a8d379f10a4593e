"""An even sample of a cloud of any size, with the normals of its surfaces.

Notation: the sample is the mean points of equal voxels, whose side doubles while the cloud is read
until at most ``SAMPLE`` are filled. Coordinates are relative to ``offset``, the file's first
point, so that those of national grids keep their precision in single precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, UInt8

from splatseed.errors import PointCloudError
from splatseed.io.clouds import open_cloud
from splatseed.progress import Progress
from splatseed.seeding.clouds.voxels import EvenVoxels

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

SAMPLE = 1 << 18
CHUNK = 1 << 19
NEIGHBORS = 12
TEXT_ROW = 40
LEAST = 1000
"""Points that a sample must have."""


@dataclass(frozen=True, eq=False)
class CloudSample:
    """An even sample of some clouds in one frame.

    Args:
        offset: What was subtracted, float64 [3].
        xyz: Positions, float64 [N, 3].
        rgb: Colours, uint8 [N, 3]; None if a cloud has none.
        spacing: The side of the voxels.
        total: Finite points that were read.
    """

    offset: Float64[np.ndarray, " 3"]
    xyz: Float64[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"] | None
    spacing: float
    total: int


def sample_cloud(paths: Sequence[Path], progress: Progress) -> CloudSample:
    """Read clouds, keeping an even sample.

    Args:
        paths: The files, in one frame.
        progress: Told how far it is.

    Raises:
        SceneNotFoundError: A file is missing.
        SceneFormatError: One is damaged.
        PointCloudError: There are too few points.
    """
    files = [open_cloud(path) for path in paths]
    painted = all(file.has_color for file in files)
    voxels, offset, total = EvenVoxels(SAMPLE), None, 0
    for file in files:
        stage, given = f"look at {file.path.name}", 0
        expected = file.count or max(file.path.stat().st_size // TEXT_ROW, 1)
        progress(stage, 0.0)
        for chunk in file.chunks(CHUNK):
            given += len(chunk)
            finite = chunk.select(chunk.finite)
            if len(finite):
                offset = finite.xyz[0].copy() if offset is None else offset
                voxels.add(finite.xyz - offset, finite.rgb if painted else None)
                total += len(finite)
            progress(stage, min(given / expected, 1.0))
    if offset is None or len(voxels) < LEAST:
        raise PointCloudError(
            f"at least {LEAST:,} points apart, to align a cloud by",
            found=f"{len(voxels):,}",
            fix="Give the transform with --transform FILE.",
        )
    rgb = voxels.rgb if painted else None
    return CloudSample(offset, voxels.xyz.astype(np.float64), rgb, voxels.spacing, total)


def normals_of(
    xyz: Float64[np.ndarray, "N 3"], tree: cKDTree, num: int = NEIGHBORS
) -> Float64[np.ndarray, "N 3"]:
    """Unit normals of either sign: the last principal axis of each point's neighbours.

    Args:
        xyz: The points.
        tree: Of them.
        num: How many neighbours, the point itself among them.
    """
    normals = np.empty_like(xyz)
    for start in range(0, len(xyz), CHUNK // 16):
        part = slice(start, start + CHUNK // 16)
        idx = tree.query(xyz[part], min(num, len(xyz)))[1]
        near = xyz[idx] - xyz[idx].mean(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    return normals
