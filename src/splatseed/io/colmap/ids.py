"""Contiguous point ids for rewriting a COLMAP model.

Notation: a *feature* is one observation slot of an image; all features of all images in a row are
numbered by *slot*. A track element (image id, feature index) and a feature's point id state the
same fact twice. Promise: in the result the two agree, ids are 1..N in the cloud's order, and a
model that satisfied this already comes out unchanged. No loop over points or features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int64

from splatseed.errors import PointCloudError
from splatseed.scene import NO_POINT, Image, Observations, Scene, Tracks


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
    _check_tracks(scene, tracks)
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
    _check_tracks(scene, tracks)
    point_idx = np.repeat(np.arange(len(tracks)), tracks.lengths)
    slots = _slots(scene.images, tracks)
    agreed = slots >= 0
    agreed[agreed] = old_ids[slots[agreed]] == tracks.point_ids[point_idx[agreed]]
    new_ids = np.full(len(old_ids), NO_POINT, np.int64)
    new_ids[slots[agreed]] = point_idx[agreed] + 1
    confirmed = np.zeros(len(old_ids), bool)
    confirmed[slots[agreed]] = True
    unconfirmed = (old_ids != NO_POINT) & ~confirmed
    return Renumbered(
        replace(
            _confirmed(tracks, agreed, point_idx),
            point_ids=np.arange(1, len(tracks) + 1, dtype=np.int64),
        ),
        _with_point_ids(scene.images, new_ids),
        int(np.count_nonzero(~agreed) + np.count_nonzero(unconfirmed)),
    )


def _check_tracks(scene: Scene, tracks: Tracks) -> None:
    if len(tracks) > len(scene.points):
        raise PointCloudError(
            "at most one track per point",
            found=f"{len(tracks)} tracks for {len(scene.points)} points",
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


def _confirmed(
    tracks: Tracks, agreed: Bool[np.ndarray, " T"], point_idx: Int64[np.ndarray, " T"]
) -> Tracks:
    """The tracks with only those elements that features agree with."""
    lengths = np.bincount(point_idx[agreed], minlength=len(tracks))
    return replace(
        tracks,
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        image_ids=tracks.image_ids[agreed],
        point2d_idx=tracks.point2d_idx[agreed],
    )


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
