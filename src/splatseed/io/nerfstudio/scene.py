"""A scene from ``transforms.json``: its cameras, and points in their space.

Notation: the *transforms' space* is the world of the file's poses. Promise: points come from the
file that the JSON names, else from a PLY known to lie in that space, else from a COLMAP model whose
cameras determine the map into that space: a known rotation of the axes, or a fitted similarity.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.io.colmap.scene import (
    empty_cloud,
    find_model,
    read_model_cameras,
    read_model_points,
)
from splatseed.io.files import odd_kind
from splatseed.io.image_checks import image_warnings, lens_warnings
from splatseed.io.nerfstudio.transforms import Transforms, apply_transform, read_transforms
from splatseed.io.ply import read_ply
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource
from splatseed.similarity import fit_similarity

_POINT_FILES = ("sparse_pc.ply", "points3d.ply", "points3D.ply", "pointcloud.ply")
_LEGACY_TRANSFORM = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""What nerfstudio applied to a COLMAP model before it wrote ``applied_transform``."""
_FEWEST_FITTED = 4
"""Three camera centres do not suffice for a similarity: it fits any three nearly as well."""
_POSE_TOLERANCE = 1e-2  # of the cameras' extent, between transforms.json and its COLMAP model


def read_transforms_scene(path: Path) -> Scene:
    """Read a ``transforms.json`` and the points that belong to it; the cloud may be empty.

    Raises:
        SceneNotFoundError: A file is missing.
        SceneFormatError: A file is not what its format promises, or the COLMAP model beside the
            JSON does not fit its poses.
    """
    transforms = read_transforms(path)
    points, points_path, notes = find_points(transforms)
    warnings = (
        *transforms.warnings,
        *notes,
        *image_warnings(transforms.images, transforms.image_dir, path.parent),
        *lens_warnings(transforms.images),
    )
    source = SceneSource(
        "transforms",
        path.parent,
        points_path,
        image_dir=transforms.image_dir,
        transforms_path=path,
    )
    return Scene(points, transforms.images, transforms.intrinsics, source=source, warnings=warnings)


def find_points(transforms: Transforms) -> tuple[PointCloud, Path, list[str]]:
    """The cloud, the file it came from, and notes for the user."""
    root, notes = transforms.path.parent, []
    named = transforms.json.get("ply_file_path")
    names = [name for name in (named, *_POINT_FILES) if isinstance(name, str)]
    if isinstance(named, str) and not (root / named).is_file():
        notes.append(f"ply_file_path {named} is {odd_kind(root / named) or 'not there'}.")
    ply = next((root / name for name in names if (root / name).is_file()), None)
    if ply is not None:
        return read_ply(ply), ply, notes
    model_dir = find_model(root / "colmap/sparse/0", root / "sparse/0", root / "sparse")
    if model_dir is None:
        return empty_cloud(), root / _POINT_FILES[0], notes
    points, points_path, doubts = _model_points(transforms, model_dir)
    return points, points_path, notes + doubts


def _model_points(transforms: Transforms, model_dir: Path) -> tuple[PointCloud, Path, list[str]]:
    """The points of a COLMAP model, brought into the transforms' space."""
    points, tracks, points_path = read_model_points(model_dir)
    _, model_images = read_model_cameras(model_dir)
    transform, doubts = _transform_of_model(transforms, model_dir, model_images)
    xyz = apply_transform(transform, points.xyz if tracks is None else tracks.xyz)
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        return points.replace(xyz=xyz.astype(np.float32)), points_path, doubts


def _transform_of_model(
    transforms: Transforms, model_dir: Path, model_images: Sequence[Image]
) -> tuple[Float64[np.ndarray, "3 4"], list[str]]:
    """The map [3, 4] from the model's world that takes its cameras onto the frames'."""
    candidates = [_LEGACY_TRANSFORM, np.eye(4)[:3]]
    if transforms.applied_transform is not None:
        candidates = [transforms.applied_transform]
    elif model_dir.parts[-3:-2] != ("colmap",):  # not a folder that nerfstudio made
        candidates.reverse()
    centers, model_centers = _common_centers(transforms.images, model_images)
    if not len(centers):
        doubt = f"no image of {model_dir} is in {transforms.path.name}; its points may lie askew."
        return candidates[0], [doubt]
    extent = max(float(np.ptp(centers, axis=0).max()), 1e-6 * float(np.abs(centers).max()))
    for candidate in candidates:
        off = np.abs(apply_transform(candidate, model_centers) - centers).max(axis=1)
        if np.median(off) <= _POSE_TOLERANCE * extent:
            return candidate, []
    fitted = fit_similarity(model_centers, centers)
    if fitted is not None:
        apart = np.abs(fitted.points(model_centers) - centers).max(axis=1)
        if len(centers) >= _FEWEST_FITTED and np.median(apart) <= _POSE_TOLERANCE * extent:
            note = (
                f"The poses of {transforms.path.name} are those of {model_dir} turned, moved and "
                f"scaled by {fitted.scale:.3g}, as instant-ngp writes them; its points were "
                "brought there."
            )
            return fitted.matrix, [note]
    raise SceneFormatError(
        f"the cameras of {model_dir} to be those of {transforms.path} after applied_transform",
        found=f"cameras {np.median(off):.3g} apart in a scene of extent {extent:.3g}",
        fix="Name a PLY in the space of the poses as ply_file_path, or read the COLMAP scene.",
    )


def _common_centers(
    images: Sequence[Image], model_images: Sequence[Image]
) -> tuple[Float64[np.ndarray, "M 3"], Float64[np.ndarray, "M 3"]]:
    """The camera centres [M, 3] of the images that both have, by file name."""
    named = {PurePath(image.name).name: image for image in model_images}
    pairs = [
        (im, named[PurePath(im.name).name]) for im in images if PurePath(im.name).name in named
    ]
    ours = [image.camera.center for image, _ in pairs]
    theirs = [image.camera.center for _, image in pairs]
    return np.reshape(ours, (-1, 3)), np.reshape(theirs, (-1, 3))
