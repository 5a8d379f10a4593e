"""``transforms.json``: the cameras of nerfstudio and instant-ngp.

Notation: a *frame* is one posed image; its ``transform_matrix`` is ``world_from_cam`` in OpenGL
axes (x right, y up, z back), ours in OpenCV's (x right, y down, z forward), so the y and z columns
change sign. The *transforms' space* is the world of the file; ``applied_transform`` [3, 4] takes
the world of the Structure-from-Motion model there. Promise: images come in the file's order with
names relative to ``image_dir``; what cannot be expressed raises an error that names the frame.

Formats: nerfstudio's "data conventions" page and instant-ngp's ``colmap2nerf`` output.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import SceneFormatError
from splatseed.io.colmap.model import MAX_ID, make_intrinsics
from splatseed.io.files import open_file, read_bytes
from splatseed.literal import told
from splatseed.scene import Image

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns camera axes from OpenGL's to OpenCV's, and back."""

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".JPEG")  # tried when a file_path has none
_RIGID_TOLERANCE = 1e-3  # of rotation @ rotation.T against the identity
_PERSPECTIVE = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_FIX = "Correct the file, or export the scene again."

_Params = tuple[str, int, int, tuple[float, ...]]


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


def read_transforms(path: Path) -> Transforms:
    """Read the cameras of a ``transforms.json``; its points are read by ``load_scene``.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not JSON, has no frames, or a frame's file name, pose or camera is
            missing or impossible.
    """
    meta = _parse(path)
    frames = _frames(path, meta)
    files = [_image_file(path, i, frame) for i, frame in enumerate(frames)]
    image_dir = _image_dir(path, files)
    names = [file.relative_to(image_dir).as_posix() for file in files]
    _check_names(path, names)
    cameras: dict[_Params, Intrinsics] = {}
    images = []
    for i, (frame, image_id) in enumerate(zip(frames, _image_ids(frames), strict=True)):
        where = f"{path}, frame {i + 1} ({names[i]})"
        camera = _camera(where, {**meta, **frame}, files[i], cameras)
        quat, translation = _pose(where, frame.get("transform_matrix"))
        images.append(Image(names[i], image_id, camera, quat, translation))
    applied = _applied_transform(path, meta)
    warnings = _lens_warnings(path, meta, frames)
    return Transforms(
        path, meta, tuple(images), tuple(cameras.values()), image_dir, applied, warnings
    )


def apply_transform(
    transform: Float64[np.ndarray, "3 4"], xyz: np.ndarray
) -> Float64[np.ndarray, "N 3"]:
    """Points [N, 3] taken through an affine map [3, 4], float64."""
    with np.errstate(invalid="ignore"):  # infinite points stay infinite or NaN
        return np.asarray(np.asarray(xyz, np.float64) @ transform[:, :3].T + transform[:, 3])


def _parse(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:  # not JSON, or not Unicode
        raise SceneFormatError(f"{path} to be JSON", found=str(error), fix=_FIX) from None
    if not isinstance(meta, dict):
        raise SceneFormatError(
            f"{path} to hold an object", found=f"{type(meta).__name__}", fix=_FIX
        )
    return meta


def _frames(path: Path, meta: Mapping[str, Any]) -> list[dict[str, Any]]:
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        other = "none" if not frames else "something else"
        raise SceneFormatError(f"{path} to have a list of frames", found=other, fix=_FIX)
    return frames


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


def _check_names(path: Path, names: Sequence[str]) -> None:
    seen: set[str] = set()
    for i, name in enumerate(names):
        if name in seen:
            where = f"{path}, frame {i + 1}"
            raise SceneFormatError(
                f"{where} to have an image of its own", found=f"{name!r} again", fix=_FIX
            )
        seen.add(name)


def _image_ids(frames: Sequence[Mapping[str, Any]]) -> list[int]:
    """COLMAP's ids where every frame has one, else 1, 2, ..."""
    ids = [frame.get("colmap_im_id") for frame in frames]
    usable = [i for i in ids if isinstance(i, int) and 0 < i <= MAX_ID]
    if len(set(usable)) == len(frames):
        return usable
    return list(range(1, len(frames) + 1))


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
    where: str, values: Mapping[str, Any], file: Path, cameras: dict[_Params, Intrinsics]
) -> Intrinsics:
    """The camera of a frame: one of ``cameras``, or a new one that is added to them."""
    width, height = _size(where, values, file)
    fl_x = _focal_length(where, values, "x", width, None)
    fl_y = _focal_length(where, values, "y", height, fl_x)
    center = _number(where, values, "cx", width / 2), _number(where, values, "cy", height / 2)
    model, distortion = _lens(where, values)
    key = (model, width, height, (fl_x, fl_y, *center, *distortion))
    if key not in cameras:
        camera_id = len(cameras) + 1
        cameras[key] = make_intrinsics(where, camera_id, model, width, height, key[3])
    return cameras[key]


def _size(where: str, values: Mapping[str, Any], file: Path) -> tuple[int, int]:
    if values.get("w") is not None and values.get("h") is not None:
        return int(_number(where, values, "w")), int(_number(where, values, "h"))
    from PIL import Image as PilImage  # noqa: PLC0415  (keeps the import of splatseed.io fast)

    try:
        with open_file(file) as opened, PilImage.open(opened) as picture:
            return picture.size
    except (OSError, ValueError, PilImage.DecompressionBombError) as error:
        raise SceneFormatError(
            f"w and h, or a readable image, in {where}", found=told(error), fix=_FIX
        ) from None


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
        raise SceneFormatError(
            f"a positive focal length fl_{axis} in {where}", found=f"{focal_length:g}", fix=_FIX
        )
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


def _lens_warnings(
    path: Path, meta: Mapping[str, Any], frames: Sequence[Mapping[str, Any]]
) -> tuple[str, ...]:
    merged = ({**meta, **frame} for frame in frames)
    odd = [v for v in merged if v.get("k4") and _lens(str(path), v)[0] != "OPENCV_FISHEYE"]
    if not odd:
        return ()
    return (f"k4 of {len(odd)} frames is not used: COLMAP's perspective models have no such term.",)


def _matrix(where: str, value: Any, shape: tuple[int, int]) -> Float64[np.ndarray, "R 4"]:
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape == (4, 4):
        matrix = matrix[: shape[0]]
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise SceneFormatError(
            f"a matrix of {shape[0]} x {shape[1]} numbers in {where}",
            found="none" if value is None else "something else",
            fix=_FIX,
        )
    return matrix


def _pose(where: str, value: Any) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """Quaternion and translation of ``cam_from_world`` in OpenCV axes."""
    world_from_cam = _matrix(f"{where}, transform_matrix", value, (3, 4)) @ OPENCV_FROM_OPENGL
    rotation = world_from_cam[:, :3].T
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > _RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise SceneFormatError(
            f"a rotation and translation as transform_matrix in {where}",
            found="a scaled, sheared or mirrored one",
            fix="Remove the scale from the poses (and from the points).",
        )
    return quat_from_rotation(rotation), -rotation @ world_from_cam[:, 3]


def _applied_transform(path: Path, meta: Mapping[str, Any]) -> Float64[np.ndarray, "3 4"] | None:
    value = meta.get("applied_transform")
    return None if value is None else _matrix(f"{path}, applied_transform", value, (3, 4))
