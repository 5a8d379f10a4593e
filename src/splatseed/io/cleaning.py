"""Points that training can use: distinct, finite, and near enough to 0 for single precision.

Notation: a duplicate has the float32 position of an earlier point. Promise: counts of what was left
out are exact, and a clean scene is returned unchanged; scenes in national grids are moved around 0
in double precision, nothing is turned or scaled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.errors import ParameterError
from splatseed.io.model import without_points
from splatseed.pointcloud import PointCloud
from splatseed.scene import LeftOut, Scene

_FAR_OUT = 1e4
"""Times the inner half of the points: the sky of outdoor scenes is at some hundred times."""
_FEW = 0.01  # of the points at most can be so far
_RESOLUTION = 1e-4
"""Steps of single precision coarser than this share of the extent show in renders."""


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


def offset_of(scene: Scene) -> Float64[np.ndarray, " 3"]:
    """The middle of the cameras, in whole units."""
    centers = np.array([image.camera.center for image in scene.images])
    return np.asarray(np.rint(centers.mean(axis=0)))


def recentred(scene: Scene, offset: Float64[np.ndarray, " 3"]) -> Scene:
    """A scene moved by ``-offset``.

    Files beside the model that hold positions no longer belong to it.
    """
    images = tuple(
        replace(image, translation=image.translation + image.camera.cam_from_world[:3, :3] @ offset)
        for image in scene.images
    )
    xyz, tracks = scene.points.xyz.astype(np.float64), scene.tracks
    if tracks is not None:
        xyz[: len(tracks)] = tracks.xyz
        tracks = replace(tracks, xyz=tracks.xyz - offset)
    source = scene.source and replace(scene.source, model_dir=None, transforms_path=None)
    points = scene.points.replace(xyz=(xyz - offset).astype(np.float32))
    return replace(scene, images=images, points=points, tracks=tracks, source=source)


def check_precision(scene: Scene) -> None:
    """Refuse a scene whose coordinates single precision cannot hold.

    Raises:
        ParameterError: It is far from 0.
    """
    if not scene.images:
        return
    centers = np.array([image.camera.center for image in scene.images])
    spread = float(np.ptp(centers, axis=0).max())
    step = float(np.spacing(np.float32(np.abs(centers).max())))
    if step > _RESOLUTION * spread > 0:
        raise ParameterError(
            "a scene near 0: seeds are written in single precision",
            found=f"cameras at {np.abs(centers).max():,.0f}, where it has steps of {step:.2g}",
            fix="Pass --recenter: it writes scene and cloud around 0, and the offset to a file.",
        )
