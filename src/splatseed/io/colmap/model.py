"""Shared by the binary and the text form of a COLMAP model.

Notation: ``where`` is the place an error names, "file, record" or "file, line". Promise: every
record either becomes one of our types with its values checked, or raises ``SceneFormatError`` that
names the place; arrays are checked whole, never point by point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import PointCloudError, SceneFormatError
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Tracks

EXPORT_AGAIN = "Copy the file again, or export the model again with COLMAP."
MAX_ID = 2**32 - 1
"""Camera ids, image ids and feature indices are 32-bit in COLMAP's binary form."""
UNKNOWN_ERROR = -1.0
"""COLMAP's reprojection error of a point that has none yet."""

_MAX_SIZE = 2**31 - 1
_NORM_RANGE = (1e-100, 1e100)  # inside it the square of a quaternion's norm is a normal float


def make_intrinsics(
    where: str, camera_id: int, model: str, width: int, height: int, params: Sequence[float]
) -> Intrinsics:
    """A checked camera record.

    Raises:
        SceneFormatError: Its id, size or parameters are impossible, or its model unknown.
    """
    if not 0 <= camera_id <= MAX_ID:
        raise _bad(f"a camera id from 0 to {MAX_ID}", where, str(camera_id))
    if not (0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE):
        raise _bad("a camera with a size in pixels", where, f"{width} x {height}")
    if not all(map(math.isfinite, params)):
        raise _bad("finite camera parameters", where, str(tuple(params)))
    try:
        camera = Intrinsics(camera_id, model, width, height, tuple(params))
    except SceneFormatError as error:
        raise SceneFormatError(
            f"{error.expected} in {where}", found=error.found, fix=error.fix
        ) from None
    lengths = camera.params[: CAMERA_MODELS[model].num_focal]
    if min(lengths) <= 0:
        raise _bad("a focal length above 0", where, ", ".join(f"{each:g}" for each in lengths))
    return camera


def by_camera_id(intrinsics: Iterable[Intrinsics]) -> dict[int, Intrinsics]:
    """The camera records by the id that images refer to."""
    return {camera.camera_id: camera for camera in intrinsics}


def make_image(
    where: str,
    cameras: Mapping[int, Intrinsics],
    *,
    image_id: int,
    camera_id: int,
    name: str,
    pose: Sequence[float],
    observations: Observations,
) -> Image:
    """A checked image record; ``pose`` is qw, qx, qy, qz, tx, ty, tz of ``cam_from_world``.

    Raises:
        SceneFormatError: Its id or name is impossible, its pose is not a finite rotation and
            translation, or no camera record has its camera id.
    """
    if not 0 <= image_id <= MAX_ID:
        raise _bad(f"an image id from 0 to {MAX_ID}", where, str(image_id))
    if not name:
        raise _bad("an image name", where, "an empty one")
    if not all(map(math.isfinite, pose)):
        raise _bad(f"a finite pose of image {name!r}", where, str(tuple(pose)))
    if not _NORM_RANGE[0] < math.hypot(*pose[:4]) < _NORM_RANGE[1]:
        raise _bad(f"a rotation quaternion of image {name!r}", where, str(tuple(pose[:4])))
    if camera_id not in cameras:
        known = f"one of the {len(cameras)} camera records"
        raise _bad(f"image {name!r} to name {known}", where, f"camera id {camera_id}")
    quat, translation = np.array(pose[:4], np.float64), np.array(pose[4:], np.float64)
    return Image(name, image_id, cameras[camera_id], quat, translation, observations)


def make_points(
    path: Path,
    place: Callable[[int], str],
    rgb: np.ndarray,
    tracks: Tracks,
) -> tuple[PointCloud, Tracks]:
    """The cloud of a file's points beside their tracks.

    Positions beyond float32 become infinite in the cloud, where they can be seen and dropped.

    Args:
        path: The file, for errors.
        place: The place of point i in the file, for errors.
        rgb: Colours, uint8 [N, 3].
        tracks: Everything else.

    Raises:
        SceneFormatError: A point id is negative (2^63 or more in the file) or occurs twice.
    """
    negative = tracks.point_ids < 0
    if negative.any():
        where = f"{path}, {place(int(negative.argmax()))}"
        raise _bad(f"a point id from 0 to {2**63 - 1}", where, "one outside")
    check_unique("point", tracks.point_ids, path, place)
    with np.errstate(over="ignore"):
        xyz = tracks.xyz.astype(np.float32)
    return PointCloud(xyz, rgb), tracks


def check_unique(
    what: str, ids: Int64[np.ndarray, " N"], path: Path, place: Callable[[int], str]
) -> None:
    """Check that no two records of a file share an id.

    Raises:
        SceneFormatError: Two do; the second is named.
    """
    if bool((np.diff(ids) > 0).all()):  # the usual order needs no sort
        return
    order = np.argsort(ids, kind="stable")
    again = order[1:][np.diff(ids[order]) == 0]
    if len(again):
        i = int(again.min())
        raise _bad(f"each {what} id once", f"{path}, {place(i)}", f"{ids[i]} a second time")


def check_names(images: Sequence[Image], path: Path, place: Callable[[int], str]) -> None:
    """Check that no two records of a file are of one image: one of the poses would be wrong.

    Raises:
        SceneFormatError: Two are; the second is named.
    """
    first: dict[str, int] = {}
    for i, image in enumerate(images):
        if first.setdefault(image.name, i) != i:
            found = f"{image.name!r} a second time, after {place(first[image.name])}"
            raise _bad("each image name once", f"{path}, {place(i)}", found)


def point_columns(
    points: PointCloud, tracks: Tracks | None
) -> tuple[Int64[np.ndarray, " N"], Float64[np.ndarray, "N 3"], Float64[np.ndarray, " N"]]:
    """Ids, float64 positions and errors of all points to be written.

    The first ``len(tracks)`` points have theirs from ``tracks``; the others get the ids that
    follow, the cloud's positions and ``UNKNOWN_ERROR``.

    Raises:
        PointCloudError: There are more tracks than points.
    """
    num_tracks = len(tracks) if tracks is not None else 0
    if num_tracks > len(points):
        raise PointCloudError(
            "at most one track per point",
            found=f"{num_tracks} tracks for {len(points)} points",
            fix="Drop the tracks of the points that were dropped.",
        )
    xyz = points.xyz.astype(np.float64)
    errors = np.full(len(points), UNKNOWN_ERROR)
    if tracks is None or not num_tracks:
        return np.arange(1, len(points) + 1, dtype=np.int64), xyz, errors
    xyz[:num_tracks], errors[:num_tracks] = tracks.xyz, tracks.errors
    first_id = int(tracks.point_ids.max()) + 1
    new_ids = np.arange(first_id, first_id + len(points) - num_tracks, dtype=np.int64)
    return np.concatenate([tracks.point_ids, new_ids]), xyz, errors


def _bad(expected: str, where: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {where}", found=found, fix=EXPORT_AGAIN)
