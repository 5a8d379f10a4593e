"""SfmReport: the result of a run of Structure-from-Motion, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

__all__ = ["SfmReport"]


@dataclass(frozen=True)
class SfmReport:
    """The outcome of ``reconstruct`` or ``triangulate``.

    Args:
        path: The scene folder that was written.
        registered: Images with a pose in the scene.
        total: Images in the folder.
        unregistered: Names of the images without a pose, sorted; they are not in the scene.
        num_points: Points in the scene.
        mean_track_length: Observations per point.
        mean_reprojection_error: Mean over points of their mean reprojection error, px of the
            scene's (undistorted) images.
        seconds: Wall time of each stage, in the order in which they ran.
    """

    path: Path
    registered: int
    total: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_track_length: float
    mean_reprojection_error: float
    seconds: Mapping[str, float]
