"""What photographs show, found once for all tests and processes of the suite: stereo and check-ups.

Most tests of commands, runs and benchmarks look at one room, which takes seconds to compare, and
half a second to hold against its points.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.checkup import examination, focal_by_pairs, pose_accuracy, poses, wrong_poses
from splatseed.depth.stereo import coarse, matching, pipeline, semiglobal
from splatseed.depth.stereo.maps import StereoResult
from splatseed.io.staging import atomic_file
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.scene import Image, Masks, Scene
from splatseed.seeding import few_photographs
from splatseed.sfm import triangulation

CHECKS_OF_POSES = (
    (poses, "check_poses"),
    (examination, "check_poses"),
    (pose_accuracy, "estimate_pose_error"),
    (focal_by_pairs, "estimate_focal_errors"),
)
CHECKS_OF_POINTS = (examination, "examine"), (wrong_poses, "find_wrong_poses")
"""Functions of a scene, some of its images, settings and the progress, as modules know them."""

_found: dict[bytes, Any] = {}
_match_views = matching.match_views
_semiglobal_depths, _triangulate = semiglobal.semiglobal_depths, triangulation.triangulate


def match_views(
    folder: Path,
    views: Sequence[View],
    priors: Any,
    sources: Any,
    settings: Any,
    seed: int,
    progress: Progress,
) -> StereoResult:
    """As ``matching.match_views``, whose result follows from all arguments but the progress.

    Results are kept in ``folder`` for the other processes.
    """
    matching.check_stereo_memory(views, settings)
    key = _digest(views, "match_views", priors, sources, settings, seed)

    def match() -> StereoResult:
        found = _match_views(views, priors, sources, settings, seed, progress)
        return replace(found, views=())

    found, lists = _once(folder, key, match), ("planes", "costs", "agreeing")
    progress("compare photographs", 1.0)
    copies = {name: [each.copy() for each in getattr(found, name)] for name in lists}
    return replace(found, views=tuple(views), **copies)


def semiglobal_depths(
    folder: Path, views: Sequence[View], xyz: np.ndarray, progress: Progress
) -> list[np.ndarray]:
    """As ``semiglobal.semiglobal_depths``."""
    semiglobal._check_memory(views)
    key = _digest(views, "semiglobal_depths", xyz)
    found = _once(folder, key, lambda: _semiglobal_depths(views, xyz, progress))
    progress("compare depths", 1.0)
    return [depth.copy() for depth in found]


def triangulate(folder: Path, views: Sequence[View], progress: Progress = silent) -> PointCloud:
    """As ``triangulation.triangulate``."""
    require("pycolmap")
    key = _digest(views, "triangulate")
    found: PointCloud = _once(folder, key, lambda: _triangulate(views, progress))
    progress("match features", 1.0)
    return found


USERS = (
    *((module, match_views) for module in (coarse, pipeline, poses)),
    (few_photographs, semiglobal_depths),
    (triangulation, triangulate),
)
"""Modules that compare photographs, and what takes the place of their function of that name."""


def checked_once(folder: Path, check: Callable[..., Any], *, of_points: bool) -> Callable[..., Any]:
    """Return a check of a scene that finds the same for all scenes of the same content.

    Errors are not kept, nor what names a scene's folder.
    """

    def found(scene: Scene, images: Sequence[Image], *others: Any) -> Any:
        if not all(image.has_photograph for image in images):
            return check(scene, images, *others)
        progress, settings = silent, []
        for each in others:
            if callable(each):
                progress = each
            else:
                settings.append(each)
        key = _digest_of_scene(scene, images, check.__qualname__, settings, of_points=of_points)
        result = copy(_once(folder, key, lambda: check(scene, images, *others)))
        if scene.source.root and str(scene.source.root) in repr(result):
            del _found[key]
            (folder / key.hex()).unlink(missing_ok=True)
        progress("check points", 1.0)
        return result

    return found


def _once(folder: Path, key: bytes, make: Callable[[], Any]) -> Any:
    kept = folder / key.hex()
    if key not in _found and kept.is_file():
        _found[key] = pickle.loads(kept.read_bytes())  # noqa: S301  (our own)
    elif key not in _found:
        _found[key] = make()
        with atomic_file(kept) as partial:
            partial.write_bytes(pickle.dumps(_found[key]))
    return _found[key]


def _digest(views: Sequence[View], *others: Any) -> bytes:
    content = hashlib.sha256(pickle.dumps(others))
    for view in views:
        mask = b"".join(part.tobytes() for part in (view.mask, view.empty) if part is not None)
        placed = view.K.tobytes() + view.cam_from_world.tobytes()
        shape = view.photograph.shape, view.name, view.near
        for each in (repr(shape).encode(), view.photograph.tobytes(), mask, placed):
            content.update(hashlib.sha256(each).digest())
    return content.digest()


def _digest_of_scene(scene: Scene, images: Sequence[Image], *others: Any, of_points: bool) -> bytes:
    masks = scene.masks or Masks({})
    files, settings = masks.files, (scene.white, scene.masks is None, masks.inverted, masks.alpha)
    content, arrays = hashlib.sha256(repr((*others, *settings)).encode()), []
    for image in images:
        content.update(repr((image.name, image.image_id, image.intrinsics)).encode())
        for path in filter(Path.is_file, (image.path, files.get(image.name, image.path))):
            content.update(hashlib.sha256(path.read_bytes()).digest())
        arrays += [image.quat, image.translation]
    if of_points:
        arrays += [scene.points.xyz, scene.points.rgb, scene.points.source]
        if scene.tracks is not None:
            arrays += vars(scene.tracks).values()
    for array in arrays:
        content.update(repr(array.shape).encode())
        content.update(np.ascontiguousarray(array).tobytes())
    return content.digest()
