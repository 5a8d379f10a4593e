"""Cleaning the points of a scene: distinct and finite, with a report of what was left out.

Notation: a duplicate has the float32 position of an earlier point. Promise: the counts are exact;
a clean scene is returned unchanged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from splatseed.io.colmap.ids import without_points
from splatseed.pointcloud import PointCloud
from splatseed.scene import LeftOut, Scene

_FAR_OUT = (
    1e4  # times the inner half of the points: the sky of outdoor scenes is at some hundred times
)
_FEW = 0.01  # of the points at most can be so far
_RESOLUTION = 1e-4  # float32 steps coarser than this share of the cloud's extent show in renders


def clean_scene(scene: Scene) -> Scene:
    """The scene with its distinct finite points only, and with their tracks and observations.

    ``left_out`` counts the others, and ``warnings`` report them.
    """
    points = scene.points
    keep = points.distinct
    if keep.all():
        return scene
    num_finite = int(np.count_nonzero(points.finite))
    left = LeftOut(len(points) - num_finite, num_finite - int(np.count_nonzero(keep)))
    known = scene.left_out
    return replace(
        without_points(scene, keep),
        warnings=(*scene.warnings, *_left_out_notes(points, left)),
        left_out=LeftOut(known.non_finite + left.non_finite, known.duplicates + left.duplicates),
    )


def _left_out_notes(points: PointCloud, left: LeftOut) -> list[str]:
    notes = []
    if left.non_finite:
        what, were = ("point is", "was") if left.non_finite == 1 else ("points are", "were")
        which = "beyond 1e15" if np.isfinite(points.xyz).all() else "not finite"
        notes.append(f"{left.non_finite:,} {what} {which} and {were} left out.")
    if left.duplicates:
        what, were = ("point repeats", "was") if left.duplicates == 1 else ("points repeat", "were")
        notes.append(f"{left.duplicates:,} {what} the position of another and {were} left out.")
    return notes


def cloud_warnings(points: PointCloud) -> tuple[str, ...]:
    """A sentence on each problem of the cloud as a whole."""
    warnings = []
    far, distance = _far_points(points)
    if far.any():
        what = "point lies" if far.sum() == 1 else "points lie"
        warnings.append(
            f"{far.sum():,} {what} up to {distance:.3g} from the middle of the others, more than"
            f" {_FAR_OUT:,.0f} times their extent: probably a reconstruction error; remove"
            f" {'it' if far.sum() == 1 else 'them'}."
        )
    if _is_too_far_out(points.select(~far)):
        warnings.append(
            "The coordinates are so large beside the scene's extent that float32 cannot resolve"
            " it; recentre the scene (subtract an offset from points and cameras) first."
        )
    return tuple(warnings)


def _far_points(points: PointCloud) -> tuple[Bool[np.ndarray, " N"], float]:
    """Which few points are out of all proportion to the others, and how far the farthest is."""
    far = np.zeros(len(points), bool)
    finite = points.finite
    xyz = points.xyz[finite].astype(np.float64)
    if len(xyz) < 2:
        return far, 0.0
    low, middle, high = np.percentile(xyz, (25, 50, 75), axis=0)
    distance = np.abs(xyz - middle).max(axis=1)
    beyond = distance > _FAR_OUT * float((high - low).max())
    if (high <= low).all() or beyond.mean() > _FEW:
        return far, 0.0
    far[finite] = beyond
    return far, float(distance.max())


def _is_too_far_out(points: PointCloud) -> bool:
    xyz = points.xyz[points.finite]
    if len(xyz) < 2:
        return False
    low, high = np.percentile(xyz, (25, 75), axis=0)
    extent = float((high.astype(np.float64) - low).max())
    step = float(np.spacing(np.abs(xyz).max()))
    return step > _RESOLUTION * extent > 0
