"""Records of a COLMAP model, whatever the form of its files, and contiguous ids for rewriting one.

Notation: ``where`` is the place an error names, "file, record" or "file, line"; a *feature* is one
observation slot of an image; all features of all images in a row are numbered by *slot*. A track
element (image id, feature index) and a feature's point id state the same fact twice. Promise: every
record either becomes one of our types with its values checked, or raises ``SceneFormatError`` that
names the place; after ``renumber`` the two facts agree, ids are 1..N in the cloud's order, and a
model that satisfied this already comes out unchanged. No loop over points or features.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64, Shaped

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import PointCloudError, SceneFormatError
from splatseed.io.files import COPY_AGAIN
from splatseed.pointcloud import PointCloud
from splatseed.scene import NO_POINT, Image, Observations, Scene, Tracks

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
    check_unique("point id", tracks.point_ids, path, place)
    with np.errstate(over="ignore"):
        xyz = tracks.xyz.astype(np.float32)
    return PointCloud(xyz, rgb), tracks


def check_unique(
    what: str, values: Shaped[np.ndarray, " N"], path: Path, place: Callable[[int], str]
) -> None:
    """Check that no two records of a file share an id or a name.

    Raises:
        SceneFormatError: Two do; the second is named.
    """
    if bool((values[1:] > values[:-1]).all()):  # the usual order needs no sort
        return
    order = np.argsort(values, kind="stable")
    again = order[1:][values[order[1:]] == values[order[:-1]]]
    if len(again):
        i = int(again.min())
        raise _bad(f"each {what} once", f"{path}, {place(i)}", f"{values[i]} a second time")


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
    _check_tracks(points, tracks)
    xyz = points.xyz.astype(np.float64)
    errors = np.full(len(points), UNKNOWN_ERROR)
    if tracks is None or not num_tracks:
        return np.arange(1, len(points) + 1, dtype=np.int64), xyz, errors
    xyz[:num_tracks], errors[:num_tracks] = tracks.xyz, tracks.errors
    first_id = int(tracks.point_ids.max()) + 1
    new_ids = np.arange(first_id, first_id + len(points) - num_tracks, dtype=np.int64)
    return np.concatenate([tracks.point_ids, new_ids]), xyz, errors


@dataclass(frozen=True, eq=False)
class Renumbered:
    """The tracks and images of a scene under the new ids of its points.

    Args:
        tracks: The originals' tracks; None if the scene has none.
        images: The images, with the features' point ids renewed.
        num_broken: References between points and features that were removed because one side
            did not confirm them.
    """

    tracks: Tracks | None
    images: tuple[Image, ...]
    num_broken: int


def without_points(scene: Scene, keep: Bool[np.ndarray, " N"]) -> Scene:
    """The scene with some points removed; their features then belong to no point.

    Args:
        scene: Its tracks belong to the first ``len(scene.tracks)`` points.
        keep: Which of the scene's points are kept.

    Raises:
        PointCloudError: There are more tracks than points.
    """
    points, tracks = scene.points.select(keep), scene.tracks
    if tracks is None:
        return replace(scene, points=points)
    _check_tracks(scene.points, tracks)
    keep = keep[: len(tracks)]
    ids = _feature_ids(scene.images)
    ids[np.isin(ids, tracks.point_ids[~keep])] = NO_POINT
    images = _with_point_ids(scene.images, ids)
    return replace(scene, points=points, tracks=tracks.select(keep), images=images)


def renumber(scene: Scene) -> Renumbered:
    """Number the points 1, 2, ... in their order.

    Args:
        scene: Its tracks belong to the first ``len(scene.tracks)`` points.

    Raises:
        PointCloudError: There are more tracks than points.
    """
    old_ids = _feature_ids(scene.images)
    if scene.tracks is None:
        unset = np.full(len(old_ids), NO_POINT, np.int64)
        num_broken = int(np.count_nonzero(old_ids != NO_POINT))
        return Renumbered(None, _with_point_ids(scene.images, unset), num_broken)
    tracks = scene.tracks
    _check_tracks(scene.points, tracks)
    point_idx = np.repeat(np.arange(len(tracks)), tracks.lengths)
    slots = _slots(scene.images, tracks)
    agreed = slots >= 0
    agreed[agreed] = old_ids[slots[agreed]] == tracks.point_ids[point_idx[agreed]]
    new_ids = np.full(len(old_ids), NO_POINT, np.int64)
    new_ids[slots[agreed]] = point_idx[agreed] + 1
    confirmed = np.zeros(len(old_ids), bool)
    confirmed[slots[agreed]] = True
    unconfirmed = (old_ids != NO_POINT) & ~confirmed
    lengths = np.bincount(point_idx[agreed], minlength=len(tracks))
    kept = replace(
        tracks,
        point_ids=np.arange(1, len(tracks) + 1, dtype=np.int64),
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        image_ids=tracks.image_ids[agreed],
        point2d_idx=tracks.point2d_idx[agreed],
    )
    return Renumbered(
        kept,
        _with_point_ids(scene.images, new_ids),
        int(np.count_nonzero(~agreed) + np.count_nonzero(unconfirmed)),
    )


def _check_tracks(points: PointCloud, tracks: Tracks | None) -> None:
    if tracks is not None and len(tracks) > len(points):
        raise PointCloudError(
            "at most one track per point",
            found=f"{len(tracks)} tracks for {len(points)} points",
            fix="Replace the points by Scene.replace, which drops tracks that do not fit.",
        )


def _feature_ids(images: Sequence[Image]) -> Int64[np.ndarray, " S"]:
    """The point id of every slot."""
    ids = [im.observations.point_ids for im in images if im.observations is not None]
    return np.concatenate([np.empty(0, np.int64), *ids])


def _feature_counts(images: Sequence[Image]) -> Int64[np.ndarray, " I"]:
    return np.array([len(im.observations or ()) for im in images], np.int64)


def _slots(images: Sequence[Image], tracks: Tracks) -> Int64[np.ndarray, " T"]:
    """The slot of every track element; -1 where there is no such image or feature."""
    if not images:
        return np.full(len(tracks.image_ids), -1, np.int64)
    counts = _feature_counts(images)
    firsts = np.cumsum(counts) - counts
    image_ids = np.array([image.image_id for image in images], np.int64)
    order = np.argsort(image_ids)
    place = np.searchsorted(image_ids[order], tracks.image_ids).clip(max=len(images) - 1)
    image_idx = order[place]
    feature_idx = tracks.point2d_idx.astype(np.int64)
    exists = (image_ids[image_idx] == tracks.image_ids) & (feature_idx < counts[image_idx])
    return np.where(exists, firsts[image_idx] + feature_idx, -1)


def _with_point_ids(
    images: Sequence[Image], point_ids: Int64[np.ndarray, " S"]
) -> tuple[Image, ...]:
    """The images with the point ids of their slots."""
    pieces = np.split(point_ids, np.cumsum(_feature_counts(images))[:-1])
    return tuple(
        image
        if image.observations is None
        else replace(image, observations=Observations(image.observations.xy, piece))
        for image, piece in zip(images, pieces, strict=False)  # no image still makes one piece
    )


def _bad(expected: str, where: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {where}", found=found, fix=COPY_AGAIN)
