"""Scenes in ``transforms.json``, of nerfstudio, instant-ngp and Blender's data sets.

Notation: a *frame* is one posed image; its ``transform_matrix`` is ``world_from_cam`` in OpenGL
axes (x right, y up, z back), ours in OpenCV's (x right, y down, z forward), so the y and z columns
change sign. The *transforms' space* is the world of the file's poses; ``applied_transform`` [3, 4]
takes the world of the Structure-from-Motion model there. Promise: images come in the file's order
with names relative to ``image_dir``; what cannot be expressed raises an error that names the frame.
Points come from the file that the JSON names, else from a PLY known to lie in that space, else from
a COLMAP model whose cameras determine the map into that space: a known rotation of the axes, or a
fitted similarity.

Source: nerfstudio's "data conventions" page and instant-ngp's ``colmap2nerf`` output.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import SceneFormatError
from splatseed.io.colmap import MAX_ID, make_intrinsics
from splatseed.io.files import guarded, odd_kind, open_file, read_json
from splatseed.io.model import (
    find_model,
    read_model_cameras,
    read_model_points,
)
from splatseed.io.photograph import image_warnings, lens_warnings
from splatseed.io.ply import read_ply
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource, Split
from splatseed.similarity import fit_similarity

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns camera axes from OpenGL's to OpenCV's, and back."""

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG")  # tried when a file_path has none
_RIGID_TOLERANCE = 1e-3  # of rotation @ rotation.T against the identity
_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_FIX = "Correct the file, or export the scene again."
_BLENDER = ("transforms_train.json", "transforms_test.json")
_POINT_FILES = ("sparse_pc.ply", "points3d.ply", "points3D.ply", "pointcloud.ply")
_LEGACY_TRANSFORM = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""What nerfstudio applied to a COLMAP model before it wrote ``applied_transform``."""
_FEWEST_FITTED = 4
"""Three camera centres do not suffice for a similarity: it fits any three nearly as well."""
_POSE_TOLERANCE = 1e-2  # of the cameras' extent, between transforms.json and its COLMAP model


@dataclass(frozen=True, eq=False)
class Transforms:
    """A ``transforms.json``, read and checked.

    Args:
        path: The file.
        json: Its content, unchanged.
        images: The posed images, in the file's order; OpenCV axes, the transforms' space.
        intrinsics: The distinct cameras of the frames, ids from 1.
        image_dir: The folder that holds all images (``images`` as a rule); names are relative
            to it.
        applied_transform: float64 [3, 4], None if the file has none.
        warnings: What could not be converted, one sentence each.
    """

    path: Path
    json: Mapping[str, Any]
    images: tuple[Image, ...]
    intrinsics: tuple[Intrinsics, ...]
    image_dir: Path
    applied_transform: Float64[np.ndarray, "3 4"] | None
    warnings: tuple[str, ...]


def read_transforms_scene(path: Path) -> Scene:
    """Read a ``transforms.json`` and the points that belong to it; the cloud may be empty.

    Raises:
        SceneNotFoundError: A file is missing.
        SceneFormatError: A file is not what its format promises, or the COLMAP model beside the
            JSON does not fit its poses.
    """
    transforms = read_transforms(path)
    points, points_path, notes = _find_points(transforms)
    folder = transforms.image_dir
    source = SceneSource(
        "transforms", path.parent, points_path, image_dir=folder, transforms_path=path
    )
    warnings = (
        *transforms.warnings,
        *notes,
        *image_warnings(transforms.images, folder, path.parent),
        *lens_warnings(transforms.images),
    )
    return Scene(points, transforms.images, transforms.intrinsics, source=source, warnings=warnings)


def is_blender(folder: Path) -> bool:
    """Whether a folder has ``transforms_train.json`` and ``transforms_test.json``."""
    return all((folder / name).is_file() for name in _BLENDER)


def read_blender(folder: Path) -> Scene:
    """Read both files as one scene, and the points in their space; the cloud may be empty.

    Images are named with their folders (``train/r_0.png``), and the split is that of the files.
    Images that only ``transforms_val.json`` has are left out.

    Raises:
        SceneNotFoundError: A file is missing.
        SceneFormatError: A file is not what its format promises.
    """
    parts = [read_transforms(folder / name) for name in _BLENDER]
    cameras: dict[tuple[object, ...], Intrinsics] = {}
    named: list[list[Image]] = [[], []]
    for part, images in zip(parts, named, strict=True):
        for image in part.images:
            lens = image.intrinsics
            key = (lens.model, lens.width, lens.height, lens.params)
            shared = cameras.setdefault(key, dataclasses.replace(lens, camera_id=len(cameras) + 1))
            path, image_id = part.image_dir / image.name, sum(map(len, named)) + 1
            within = folder.absolute() in path.parents
            name = path.relative_to(folder.absolute()).as_posix() if within else str(path)
            images.append(
                dataclasses.replace(image, name=name, image_id=image_id, intrinsics=shared)
            )
    train, test = named
    points, points_path, notes = _find_points(parts[0])
    return Scene(
        points,
        (*train, *test),
        tuple(cameras.values()),
        source=SceneSource("transforms", folder, points_path, image_dir=folder),
        warnings=(
            *dict.fromkeys((*parts[0].warnings, *parts[1].warnings, *notes)),
            *image_warnings((*train, *test), folder, folder),
            *lens_warnings((*train, *test)),
        ),
        listed=Split(
            frozenset(image.name for image in train),
            frozenset(image.name for image in test),
            f"pair of {_BLENDER[0]} and {_BLENDER[1]}",
        ),
    )


def read_transforms(path: Path) -> Transforms:
    """Read the cameras of a ``transforms.json``; its points are read by ``load_scene``.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not JSON, has no frames, or a frame's file name, pose or camera is
            missing or impossible.
    """
    meta = read_json(path, fix=_FIX)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        found = "something else" if frames else "none"
        raise SceneFormatError(f"{path} to have a list of frames", found=found, fix=_FIX)
    files = [_image_file(path, i, frame) for i, frame in enumerate(frames)]
    image_dir = _image_dir(path, files)
    names = [file.relative_to(image_dir).as_posix() for file in files]
    cameras: dict[tuple[str, int, int, tuple[float, ...]], Intrinsics] = {}
    images: list[Image] = []
    seen: set[str] = set()
    odd = 0
    for i, (frame, image_id) in enumerate(zip(frames, _image_ids(frames), strict=True)):
        where = f"{path}, frame {i + 1} ({names[i]})"
        if names[i] in seen:
            expected = f"{where} to have an image of its own"
            raise SceneFormatError(expected, found=f"{names[i]!r} again", fix=_FIX)
        seen.add(names[i])
        values = {**meta, **frame}
        key = _camera(where, values, files[i])
        if key not in cameras:
            cameras[key] = make_intrinsics(where, len(cameras) + 1, *key)
        odd += bool(values.get("k4")) and key[0] != "OPENCV_FISHEYE"
        quat, translation = _pose(where, frame.get("transform_matrix"))
        images.append(Image(names[i], image_id, cameras[key], quat, translation))
    applied = meta.get("applied_transform")
    if applied is not None:
        applied = _matrix(f"{path}, applied_transform", applied)
    note = f"k4 of {odd} frames is not used: COLMAP's perspective models have no such term."
    warnings = (note,) if odd else ()
    return Transforms(
        path, meta, tuple(images), tuple(cameras.values()), image_dir, applied, warnings
    )


def apply_transform(
    transform: Float64[np.ndarray, "3 4"], xyz: np.ndarray
) -> Float64[np.ndarray, "N 3"]:
    """Points [N, 3] taken through an affine map [3, 4], float64."""
    with np.errstate(invalid="ignore"):  # infinite points stay infinite or NaN
        return np.asarray(np.asarray(xyz, np.float64) @ transform[:, :3].T + transform[:, 3])


def _image_file(path: Path, idx: int, frame: Mapping[str, Any]) -> Path:
    """The absolute path of a frame's image, which may not exist."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name or "\0" in name:
        where = f"{path}, frame {idx + 1}"
        raise SceneFormatError(f"a file_path in {where}", found=repr(name), fix=_FIX)
    file = Path(os.path.abspath(path.parent / name))  # noqa: PTH100  (resolve would follow links)
    if file.suffix in _SUFFIXES or file.is_file():
        return file
    candidates = (file.with_name(file.name + suffix) for suffix in _SUFFIXES)
    return next((candidate for candidate in candidates if candidate.is_file()), file)


def _image_dir(path: Path, files: Sequence[Path]) -> Path:
    """The folder beside the file that holds all images, else the deepest one that does."""
    shared = Path(os.path.commonpath([file.parent for file in files]))
    root = Path(os.path.abspath(path)).parent  # noqa: PTH100  (as the files: links not followed)
    if root not in shared.parents:
        return shared
    return root / shared.relative_to(root).parts[0]  # images, so that names are as in COLMAP


def _image_ids(frames: Sequence[Mapping[str, Any]]) -> list[int]:
    """COLMAP's ids where every frame has one, else 1, 2, ..."""
    ids = [frame.get("colmap_im_id") for frame in frames]
    usable = [i for i in ids if isinstance(i, int) and 0 < i <= MAX_ID]
    return usable if len(set(usable)) == len(frames) else list(range(1, len(frames) + 1))


def _number(where: str, values: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    try:
        number = float(value) if not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        other = "none" if value is None else repr(value)
        raise SceneFormatError(f"a number {key} in {where}", found=other, fix=_FIX)
    return number


def _camera(
    where: str, values: Mapping[str, Any], file: Path
) -> tuple[str, int, int, tuple[float, ...]]:
    """COLMAP's model, width, height and parameters of a frame's camera."""
    if values.get("w") is not None and values.get("h") is not None:
        width, height = int(_number(where, values, "w")), int(_number(where, values, "h"))
    else:
        from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

        expected = f"a readable image, or w and h to be, in {where}"
        with guarded(file, expected, fix=_FIX), open_file(file) as opened:
            width, height = PilImage.open(opened).size
    fl_x = _focal_length(where, values, "x", width, None)
    fl_y = _focal_length(where, values, "y", height, fl_x)
    center = _number(where, values, "cx", width / 2), _number(where, values, "cy", height / 2)
    model, distortion = _lens(where, values)
    return model, width, height, (fl_x, fl_y, *center, *distortion)


def _focal_length(
    where: str, values: Mapping[str, Any], axis: str, size: int, default: float | None
) -> float:
    angle = values.get(f"camera_angle_{axis}")
    if values.get(f"fl_{axis}") is None and angle is not None:
        half = math.tan(_number(where, values, f"camera_angle_{axis}") / 2)
        focal_length = 0.5 * size / half if half else math.inf
    else:
        focal_length = _number(where, values, f"fl_{axis}", default)
    if not 0 < focal_length < math.inf:
        expected = f"a positive focal length fl_{axis} in {where}"
        raise SceneFormatError(expected, found=f"{focal_length:g}", fix=_FIX)
    return focal_length


def _lens(where: str, values: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model and distortion parameters; COLMAP has no k4 of a perspective lens."""
    model = str(values.get("camera_model", "OPENCV"))
    k1, k2, k3, k4, p1, p2 = (_number(where, values, key, 0.0) for key in _DISTORTION)
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye") is True:
        return "OPENCV_FISHEYE", (k1, k2, k3, k4)
    if model not in _PERSPECTIVE:
        raise SceneFormatError(
            f"a perspective or OPENCV_FISHEYE camera_model in {where}",
            found=repr(model),
            fix="Convert the images to a perspective projection first.",
        )
    if k3:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    if any((k1, k2, p1, p2)):
        return "OPENCV", (k1, k2, p1, p2)
    return "PINHOLE", ()


def _matrix(where: str, value: Any) -> Float64[np.ndarray, "3 4"]:
    """The first three rows of a matrix."""
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in {(3, 4), (4, 4)} or not np.isfinite(matrix[:3]).all():
        found = "none" if value is None else "something else"
        raise SceneFormatError(f"a matrix of 3 x 4 numbers in {where}", found=found, fix=_FIX)
    return matrix[:3]


def _pose(where: str, value: Any) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """Quaternion and translation of ``cam_from_world`` in OpenCV axes."""
    world_from_cam = _matrix(f"{where}, transform_matrix", value) @ OPENCV_FROM_OPENGL
    rotation = world_from_cam[:, :3].T
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > _RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise SceneFormatError(
            f"a rotation and translation as transform_matrix in {where}",
            found="a scaled, sheared or mirrored one",
            fix="Remove the scale from the poses (and from the points).",
        )
    return quat_from_rotation(rotation), -rotation @ world_from_cam[:, 3]


def _find_points(transforms: Transforms) -> tuple[PointCloud, Path, list[str]]:
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
        return PointCloud.empty(), root / _POINT_FILES[0], notes
    points, tracks, points_path = read_model_points(model_dir)
    _, model_images = read_model_cameras(model_dir)
    transform, doubts = _transform_of_model(transforms, model_dir, model_images)
    xyz = apply_transform(transform, points.xyz if tracks is None else tracks.xyz)
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        return points.replace(xyz=xyz.astype(np.float32)), points_path, notes + doubts


def _transform_of_model(
    transforms: Transforms, model_dir: Path, model_images: Sequence[Image]
) -> tuple[Float64[np.ndarray, "3 4"], list[str]]:
    """The map [3, 4] from the model's world that takes its cameras onto the frames'."""
    candidates = [_LEGACY_TRANSFORM, np.eye(4)[:3]]
    if transforms.applied_transform is not None:
        candidates = [transforms.applied_transform]
    elif model_dir.parts[-3:-2] != ("colmap",):  # not a folder that nerfstudio made
        candidates.reverse()
    pairs = list(_common_centers(transforms.images, model_images))
    if not pairs:
        doubt = f"no image of {model_dir} is in {transforms.path.name}; its points may lie askew."
        return candidates[0], [doubt]
    centers, model_centers = (np.array(each) for each in zip(*pairs, strict=True))
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
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The camera centres, here and in the model, of the images that both have, by file name."""
    named = {PurePath(image.name).name: image for image in model_images}
    for image in images:
        other = named.get(PurePath(image.name).name)
        if other is not None:
            yield image.camera.center, other.camera.center
