"""Clean points for training (finite, distinct) and renumber them for COLMAP's files.

A duplicate has the float32 position of an earlier point. A *slot* numbers the 2D features of all
images consecutively. A track element (image id, feature index) and a feature's point id are
redundant records of one observation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int64

from splatseed.findings import Finding
from splatseed.io.colmap import check_tracks
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, LeftOut, Scene
from splatseed.text import agreeing, counted
from splatseed.tracks import NO_POINT, Observations, Tracks

_FAR_OUT = 1e4
"""Interquartile extents from which points are outliers; skies are at some hundred."""
_FEW = 0.01  # largest share of outliers


def clean_scene(scene: Scene) -> Scene:
    """Keep distinct finite points, with their tracks and observations.

    ``left_out`` counts the other points, and ``findings`` report them.
    """
    points, known = scene.points, scene.left_out
    keep = points.distinct
    if keep.all():
        return scene
    num_finite = int(np.count_nonzero(points.finite))
    non_finite, duplicates = len(points) - num_finite, num_finite - int(np.count_nonzero(keep))
    findings = []
    if non_finite:
        which = "beyond 1e15" if np.isfinite(points.xyz).all() else "not finite"
        are = agreeing(non_finite, f"is {which} and was", f"are {which} and were")
        text = f"{counted(non_finite, 'point')} {are} left out."
        findings.append(Finding("non-finite-points", text))
    if duplicates:
        those = counted(duplicates, "point")
        repeat, were = ("repeats", "was") if duplicates == 1 else ("repeat", "were")
        text = f"{those} {repeat} the position of another and {were} left out."
        findings.append(Finding("duplicate-points", text))
    return replace(
        without_points(scene, keep),
        findings=(*scene.findings, *findings),
        left_out=LeftOut(known.non_finite + non_finite, known.duplicates + duplicates),
    )


def without_points(scene: Scene, keep: Bool[np.ndarray, " N"]) -> Scene:
    """Keep the points of a mask; features of the other points lose their point id."""
    points, tracks = scene.points.select(keep), scene.tracks
    if tracks is None:
        return replace(scene, points=points)
    check_tracks(scene.points, tracks)
    keep = keep[: len(tracks)]
    ids = _feature_ids(scene.images)
    ids[np.isin(ids, tracks.point_ids[~keep])] = NO_POINT
    images = _with_point_ids(scene.images, ids)
    return replace(scene, points=points, tracks=tracks.select(keep), images=images)


def renumber(scene: Scene) -> tuple[Tracks | None, tuple[Image, ...], int]:
    """Number the points 1, 2, ... in their order; tracks belong to the first points.

    Returns:
        The tracks, if any; the images with new point ids; and the number of references between
        points and features that were removed because only one side has them.
    """
    old_ids, tracks = _feature_ids(scene.images), scene.tracks
    new_ids = np.full(len(old_ids), NO_POINT, np.int64)
    if tracks is None:
        images = _with_point_ids(scene.images, new_ids)
        return None, images, int(np.count_nonzero(old_ids != NO_POINT))
    check_tracks(scene.points, tracks)
    point_idx = np.repeat(np.arange(len(tracks)), tracks.lengths)
    slots = _slots(scene.images, tracks)
    agreed = slots >= 0
    agreed[agreed] = old_ids[slots[agreed]] == tracks.point_ids[point_idx[agreed]]
    new_ids[slots[agreed]] = point_idx[agreed] + 1
    unconfirmed = (old_ids != NO_POINT) & (new_ids == NO_POINT)
    lengths = np.bincount(point_idx[agreed], minlength=len(tracks))
    kept = replace(
        tracks,
        point_ids=np.arange(1, len(tracks) + 1, dtype=np.int64),
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        image_ids=tracks.image_ids[agreed],
        point2d_idx=tracks.point2d_idx[agreed],
    )
    num_broken = int(np.count_nonzero(~agreed) + np.count_nonzero(unconfirmed))
    return kept, _with_point_ids(scene.images, new_ids), num_broken


def _feature_ids(images: Sequence[Image]) -> Int64[np.ndarray, " S"]:
    """Return the point id of every slot."""
    ids = [im.observations.point_ids for im in images if im.observations is not None]
    return np.concatenate([np.empty(0, np.int64), *ids])


def _feature_counts(images: Sequence[Image]) -> Int64[np.ndarray, " I"]:
    return np.array([len(im.observations or ()) for im in images], np.int64)


def _slots(images: Sequence[Image], tracks: Tracks) -> Int64[np.ndarray, " T"]:
    """Return the slot of every track element; -1 without such an image or feature."""
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
    pieces = np.split(point_ids, np.cumsum(_feature_counts(images))[:-1])
    # zip is not strict: without images, np.split returns one empty piece.
    return tuple(
        image
        if image.observations is None
        else replace(image, observations=Observations(image.observations.xy, piece))
        for image, piece in zip(images, pieces, strict=False)
    )


def outlier_findings(points: PointCloud) -> tuple[Finding, ...]:
    """Report points far outside of the cloud."""
    xyz = points.xyz[points.finite]
    if len(xyz) < 2:
        return ()
    low, middle, high = np.percentile(xyz.astype(np.float64), (25, 50, 75), axis=0)
    distance = np.abs(xyz - middle).max(axis=1)
    far = distance > _FAR_OUT * float((high - low).max())
    if far.any() and far.mean() <= _FEW and (high > low).any():
        number = int(far.sum())
        lie, them = agreeing(number, "lies", "lie"), agreeing(number, "it", "them")
        text = (
            f"{counted(number, 'point')} {lie} up to {distance.max():.3g} from the middle of the"
            f" others, more than {_FAR_OUT:,.0f} times their extent: probably a reconstruction"
            f" error; remove {them}."
        )
        return (Finding("outlying-points", text),)
    return ()
