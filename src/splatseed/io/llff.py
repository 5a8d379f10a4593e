"""LLFF scenes: ``poses_bounds.npy`` beside a folder of photographs.

Each row is a row-major 3 x 5 matrix, then near and far depth. The matrix is ``world_from_cam``
[3, 4] with camera axes down, right, back, and a column of height, width and focal length. Rows
follow the photographs sorted by name. Principal points are image centres; there is no distortion.
Source: LLFF's ``pose_utils.py`` and README.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.camera_records import make_intrinsics, rigid_pose
from splatseed.io.colmap_model import IMAGE_DIRS
from splatseed.io.files import StrPath, image_names, open_file, read_npy, translate_errors
from splatseed.io.mask_files import masks_among
from splatseed.io.origin import recentered
from splatseed.io.photograph_checks import photograph_findings, photograph_size
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource
from splatseed.text import counted

POSES = "poses_bounds.npy"
_CONVENTION = "poses_bounds.npy holds world_from_cam, with camera axes down, right, back"
_OPENCV_FROM_LLFF = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""Columns: LLFF's axes (down, right, back) in OpenCV's (right, down, forward)."""
_MAX_BYTES = 1 << 28


def is_llff(folder: Path) -> bool:
    """Whether a folder has ``poses_bounds.npy``."""
    return (folder / POSES).is_file()


def read_llff(root: StrPath) -> Scene:
    """Read photographs and poses; the cloud is empty."""
    root = Path(root)
    path = root / POSES
    rows = _read_rows(path)
    folder, names = _photographs(root, len(rows))
    cameras: dict[tuple[float, ...], Intrinsics] = {}
    images, size = [], _size(folder / names[0])
    for i, (name, row) in enumerate(zip(names, rows, strict=True)):
        where = f"{path}, row {i + 1} ({name})"
        matrix = row[:15].reshape(3, 5)
        key = tuple(matrix[:, 4].tolist())
        if key not in cameras:
            cameras[key] = _camera(where, len(cameras) + 1, key, size)
        world_from_cam = np.hstack([matrix[:, :3] @ _OPENCV_FROM_LLFF.T, matrix[:, 3:4]])
        images.append(Image(name, i + 1, cameras[key], *rigid_pose(where, world_from_cam)))
    scene = Scene(
        PointCloud.empty(),
        tuple(images),
        tuple(cameras.values()),
        source=SceneSource("llff", root, path, image_dir=folder, convention=_CONVENTION),
        findings=tuple(photograph_findings(images, folder, root)),
    )
    return recentered(scene)


def _read_rows(path: Path) -> Float64[np.ndarray, "N 17"]:
    expected = "LLFF's poses, rows of 17 finite numbers"
    with translate_errors(path, expected), open_file(path) as file:
        rows = read_npy(file, _MAX_BYTES)
        if rows.ndim != 2 or rows.shape[1] not in {15, 17} or not len(rows):
            raise ValueError(f"an array of {' x '.join(map(str, rows.shape))}")
        rows = rows.astype(np.float64)
        if not np.isfinite(rows[:, :15]).all():
            raise ValueError("values that are not finite")
        return rows


def _photographs(root: Path, count: int) -> tuple[Path, list[str]]:
    found = dict[Path, list[str]]()
    for folder in (root / name for name in IMAGE_DIRS):
        names = image_names(folder)
        found[folder] = sorted(set(names) - masks_among(names))
        if len(found[folder]) == count:
            return folder, found[folder]
    counts = [f"{len(names)} in {folder.name}" for folder, names in found.items() if names]
    expected = (
        f"{counted(count, 'photograph')} in {root / IMAGE_DIRS[0]}, one for each pose of {POSES}"
    )
    fix = "Provide exactly the photographs of the poses."
    if not counts:
        raise SceneNotFoundError(expected, found="none", fix=fix)
    raise SceneFormatError(expected, found=" and ".join(counts), fix=fix)


def _size(path: Path) -> tuple[int, int] | None:
    """Read a photograph's size; None if unreadable, which is reported later."""
    with suppress(SceneFormatError, SceneNotFoundError):
        return photograph_size(path)
    return None


def _camera(
    where: str, camera_id: int, hwf: Sequence[float], size: tuple[int, int] | None
) -> Intrinsics:
    """Make the camera of photographs of a size that may be a reduced copy of the poses'."""
    height, width, focal = hwf
    if not (width > 0 and height > 0):
        return make_intrinsics(where, camera_id, "PINHOLE", int(width), int(height), (focal,) * 4)
    x = y = 1.0
    if size is not None and abs(size[0] * height - size[1] * width) <= max(width, height):
        x, y = size[0] / width, size[1] / height
    w, h = round(width * x), round(height * y)
    return make_intrinsics(where, camera_id, "PINHOLE", w, h, (focal * x, focal * y, w / 2, h / 2))
