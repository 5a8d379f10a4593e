"""The content of a ``transforms.json`` to be written.

Notation: as in ``splatseed.io.nerfstudio.transforms``. Promise: a file that was read keeps all its
fields; a new one has those that nerfstudio's own conversion of a COLMAP model writes, which
OpenSplat, Brush and LichtFeld Studio read too.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import OutputError
from splatseed.io.nerfstudio.transforms import OPENCV_FROM_OPENGL, Transforms
from splatseed.scene import Image, Scene

NERFSTUDIO_FROM_COLMAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""The ``applied_transform`` that nerfstudio gives a COLMAP model: (x, y, z) -> (x, z, -y)."""

_PATH_KEYS = ("file_path", "mask_path", "depth_file_path")
_LIST_KEYS = ("train_filenames", "val_filenames", "test_filenames")
_OPENCV_TERMS = ("k1", "k2", "p1", "p2")  # in the order of COLMAP's parameters
_FISHEYE_TERMS = ("k1", "k2", "k3", "k4")
_NERFSTUDIO_MODELS = {
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
}


def applied_transform(scene: Scene) -> Float64[np.ndarray, "3 4"] | None:
    """What a new ``transforms.json`` turns the world by; None where it was read from such files."""
    kept = scene.source is not None and scene.source.format == "transforms"
    return None if kept else NERFSTUDIO_FROM_COLMAP


def transforms_json(scene: Scene) -> dict[str, Any]:
    """A new ``transforms.json`` for a scene, as nerfstudio writes it.

    Poses are turned by ``applied_transform``, in OpenGL axes; images are ``images/NAME``. There is
    no ``ply_file_path``.

    Raises:
        OutputError: A camera model has no counterpart in nerfstudio.
    """
    used = {image.intrinsics.camera_id: image.intrinsics for image in scene.images}
    cameras = {camera_id: _camera_fields(camera) for camera_id, camera in used.items()}
    first = next(iter(cameras.values()), {})
    shared = first if len(used) == 1 else {"camera_model": first.get("camera_model", "OPENCV")}
    frames = []
    A = applied_transform(scene)
    for image in scene.images:
        own = {} if len(used) == 1 else cameras[image.intrinsics.camera_id]
        frames.append(
            {
                "file_path": f"images/{image.name}",
                "transform_matrix": _opengl_pose(image, A).tolist(),
                "colmap_im_id": image.image_id,
                **own,
            }
        )
    return {
        **shared,
        "frames": frames,
        **({} if A is None else {"applied_transform": A.tolist()}),
    }


def kept_json(transforms: Transforms, names: Collection[str]) -> dict[str, Any]:
    """The file's content for use in another folder.

    Paths that lead out of the file's folder become absolute; everything else stays.

    Args:
        transforms: The file as it was read.
        names: The images to keep.
    """
    root = transforms.path.parent
    pairs = zip(transforms.json["frames"], transforms.images, strict=True)
    frames = [frame for frame, image in pairs if image.name in names]
    dropped = [
        f
        for f, image in zip(transforms.json["frames"], transforms.images, strict=True)
        if image.name not in names
    ]
    lists = _kept_lists(transforms.json, dropped, root)
    return {**transforms.json, **lists, "frames": [_portable(frame, root) for frame in frames]}


def _kept_lists(
    content: Mapping[str, Any], dropped: Iterable[Mapping[str, Any]], root: Path
) -> dict[str, list[str]]:
    """The file lists of nerfstudio's split, which fails over names that no frame has."""
    gone = {os.path.normpath(str(frame["file_path"])) for frame in dropped}
    return {
        key: [
            _portable({"file_path": name}, root)["file_path"]
            for name in content[key]
            if isinstance(name, str) and os.path.normpath(name) not in gone
        ]
        for key in _LIST_KEYS
        if isinstance(content.get(key), list)
    }


def frame_paths(frames: Iterable[Mapping[str, Any]]) -> list[str]:
    """All paths in the frames, relative to the file."""
    paths = (frame.get(key) for frame in frames for key in _PATH_KEYS)
    return [path for path in paths if isinstance(path, str) and not Path(path).is_absolute()]


def _portable(frame: Mapping[str, Any], root: Path) -> dict[str, Any]:
    moved = {
        key: os.path.abspath(root / path)  # noqa: PTH100  (resolve would follow links)
        for key in _PATH_KEYS
        if isinstance(path := frame.get(key), str) and os.path.normpath(path).startswith("..")
    }
    return {**frame, **moved}


def _opengl_pose(image: Image, A: Float64[np.ndarray, "3 4"] | None) -> Float64[np.ndarray, "4 4"]:
    """``world_from_cam`` in OpenGL axes, turned by A."""
    pose = image.camera.world_from_cam @ OPENCV_FROM_OPENGL
    if A is not None:
        pose[:3] = A @ pose
    return np.asarray(pose)


def _camera_fields(camera: Intrinsics) -> dict[str, Any]:
    """The fields of one camera record, under nerfstudio's names."""
    if camera.model not in _NERFSTUDIO_MODELS:
        raise OutputError(
            "cameras that transforms.json can express",
            found=f"camera {camera.camera_id} of model {camera.model}",
            fix="Undistort the scene first (splatseed undistort), or write the COLMAP layout.",
        )
    fisheye = camera.model.endswith("FISHEYE")
    names = _FISHEYE_TERMS if fisheye else _OPENCV_TERMS
    terms = camera.params[CAMERA_MODELS[camera.model].num_focal + 2 :]
    matrix = camera.K
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
        **dict(zip(names, (*terms, 0.0, 0.0, 0.0, 0.0), strict=False)),
    }
