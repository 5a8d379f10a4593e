"""A COLMAP model as a scene: where its files are, what they hold, and new ids for its points.

Notation: a *model* is a folder with cameras, images and points3D, each as ``.bin`` or ``.txt``;
``points3D.ply`` stands in for missing points. A *feature* is one observation slot of an image; all
features of all images in a row are numbered by *slot*. A track element (image id, feature index)
and a feature's point id state the same fact twice. Promise: ``.bin`` is preferred to ``.txt``; a
model without images still gives its cloud and cameras; after ``renumber`` the two facts agree and
ids are 1..N in the cloud's order, without a loop over points or features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64

from splatseed.camera import Intrinsics
from splatseed.errors import SceneNotFoundError
from splatseed.io.colmap import check_tracks, read_cameras, read_images, read_points3d
from splatseed.io.photograph import image_warnings, lens_warnings
from splatseed.io.ply import read_ply
from splatseed.pointcloud import PointCloud
from splatseed.scene import NO_POINT, Image, Observations, Scene, SceneSource, Tracks

_MODEL_FILES = ("cameras", "images", "points3D")
_IMAGE_DIRS = ("images", "images_2", "images_4", "images_8", "image", "input")


def find_model(*folders: Path) -> Path | None:
    """The first of the given folders that holds a model."""
    holding = (f for f in folders if any(_model_file(f, name) for name in _MODEL_FILES))
    return next(holding, None)


def _model_file(model_dir: Path, name: str) -> Path | None:
    suffixes = (".bin", ".txt", ".ply") if name == "points3D" else (".bin", ".txt")
    candidates = (model_dir / f"{name}{suffix}" for suffix in suffixes)
    return next((path for path in candidates if path.is_file()), None)


def scene_root(model_dir: Path) -> Path:
    """The scene's folder: the model's without ``sparse/0`` or ``sparse``, or ``colmap`` above."""
    parts = model_dir.absolute().parts
    levels = 1 if parts[-1] == "sparse" else 2 if parts[-2:-1] == ("sparse",) else 0
    if not levels:
        return model_dir
    levels += parts[-levels - 1] == "colmap"
    named = model_dir if len(model_dir.parts) >= levels else model_dir.absolute()
    return named.parents[levels - 1]


def read_colmap_scene(model_dir: Path) -> Scene:
    """The scene of a model: its images, its points, and warnings for the user."""
    root = scene_root(model_dir)
    intrinsics, images = read_model_cameras(model_dir)
    points, tracks, points_path = read_model_points(model_dir)
    # The first known folder that holds the first image, else the first that exists.
    folders = [root / name for name in _IMAGE_DIRS if (root / name).is_dir()]
    first = images[0].name if images else ""
    holding = (folder for folder in (*folders, root) if first and (folder / first).is_file())
    image_dir = next(holding, folders[0] if folders else None)
    warnings = [*image_warnings(images, image_dir, root), *lens_warnings(images)]
    if model_dir.name == "0" and find_model(model_dir.with_name("1")):
        warnings.append(f"{model_dir.parent} has several models; this is {model_dir.name}.")
    if (root / "transforms.json").is_file():
        warnings.append(f"{root / 'transforms.json'} is there too; name it to read it instead.")
    if not images and (tracks is not None or intrinsics or image_dir is not None):
        tracks, path = None, _model_file(model_dir, "images")  # tracks name images
        why = f"{path} lists no images" if path else f"{model_dir} has no images.bin or images.txt"
        warnings.append(
            f"{why}, so no photograph has a pose: copy the whole model, or make one with splatseed"
            " sfm IMAGES -o SCENE. Points can be interpolated, but nothing can be trained."
        )
    source = SceneSource("colmap", root, points_path, model_dir, image_dir)
    return Scene(points, images, intrinsics, tracks, source, tuple(warnings))


def read_model_cameras(
    model_dir: Path,
) -> tuple[tuple[Intrinsics, ...], tuple[Image, ...]]:
    """The camera and the image records of a model."""
    cameras_path, images_path = _model_file(model_dir, "cameras"), _model_file(model_dir, "images")
    if cameras_path is None and images_path is not None:
        raise SceneNotFoundError(
            f"cameras.bin or cameras.txt beside {images_path}",
            found="neither",
            fix="Copy the whole model.",
        )
    intrinsics = read_cameras(cameras_path) if cameras_path else ()
    return intrinsics, read_images(images_path, intrinsics) if images_path else ()


def read_model_points(model_dir: Path) -> tuple[PointCloud, Tracks | None, Path]:
    """The points of a model, their tracks if any, and the file they came from."""
    path = _model_file(model_dir, "points3D")
    if path is None:
        return PointCloud.empty(), None, model_dir / "points3D.bin"
    if path.suffix == ".ply":
        return read_ply(path), None, path
    return *read_points3d(path), path


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
    check_tracks(scene.points, tracks)
    keep = keep[: len(tracks)]
    ids = _feature_ids(scene.images)
    ids[np.isin(ids, tracks.point_ids[~keep])] = NO_POINT
    images = _with_point_ids(scene.images, ids)
    return replace(scene, points=points, tracks=tracks.select(keep), images=images)


def renumber(scene: Scene) -> tuple[Tracks | None, tuple[Image, ...], int]:
    """Number the points 1, 2, ... in their order.

    Args:
        scene: Its tracks belong to the first ``len(scene.tracks)`` points.

    Returns:
        The originals' tracks, None if the scene has none; the images, with the features' point ids
        renewed; and how many references between points and features were removed because one side
        did not confirm them. A model that is numbered so already comes out unchanged.

    Raises:
        PointCloudError: There are more tracks than points.
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
