"""SfmReport: the result of a run of Structure-from-Motion, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Refinement:
    """What the refinement of given poses changed.

    Args:
        kept: The given poses were good: refined ones would have lowered the error by less than
            0.1 px, so none was changed.
        error_before: Mean over points of their mean reprojection error at the given poses, px of
            the photographs, for the observations that fit refined poses.
        error_after: The same at the scene's poses.
        median_shift: Median over the cameras of how far each moved, scene units.
        largest_shift: The largest, scene units.
        median_turn: Median over the cameras of the angle by which each turned, degrees.
        largest_turn: The largest, degrees.
    """

    kept: bool
    error_before: float
    error_after: float
    median_shift: float
    largest_shift: float
    median_turn: float
    largest_turn: float


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
        refinement: What refinement changed; None where it was not asked for.
    """

    path: Path
    registered: int
    total: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_track_length: float
    mean_reprojection_error: float
    seconds: Mapping[str, float]
    refinement: Refinement | None = None
