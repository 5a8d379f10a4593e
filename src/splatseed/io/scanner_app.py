"""Exports of 3D Scanner App ("All Data"): photographs, ARKit's poses and LiDAR depth.

A frame N (five digits) has ``frame_N.json`` with ``cameraPoseARFrame`` (row-major 4 x 4, ARKit's
``world_from_cam``) and ``intrinsics`` (row-major K in pixels of the photograph), a photograph
``frame_N.jpg`` if it is a key frame, ``depth_N.png`` (planar z, 16-bit millimetres; in some
versions ``frame_N.exr``, metres) and ``conf_N.png`` (ARKit's levels 0 to 2). Source: the app's
exports; ``projectionMatrix`` in the same file gives the size that ``intrinsics`` belong to, and
that half a pixel is to be added.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.camera_records import left_out
from splatseed.io.depth_maps import match_by_name
from splatseed.io.files import StrPath
from splatseed.io.phone import (
    EXPORT_AGAIN,
    HALF_PIXEL,
    PhoneFrame,
    read_matrix,
    read_phone_scene,
    read_record,
    without_photograph,
)
from splatseed.io.photograph_checks import Size, photograph_size
from splatseed.scene import Scene
from splatseed.text import counted

_RECORD = re.compile(r"frame_\d{5,}\.json")
_PHOTOGRAPH = re.compile(r"frame_\d{5,}\.(?:jpe?g|png)", re.IGNORECASE)
_MIN_SCALE = 1e-3
"""Smallest plausible 2 fx / width: a telescope's."""
_ROUNDING = 0.05
"""Pixels by which a size from float32 matrices may differ from a whole number."""


def is_scanner_app(folder: Path) -> bool:
    """Whether a folder has a frame's record of 3D Scanner App."""
    with suppress(OSError):  # one that may not be listed is no scene
        return any(_RECORD.fullmatch(path.name) for path in folder.iterdir())
    return False


def is_photograph(name: str) -> bool:
    """Whether a file of an export has the name of a frame's photograph."""
    return _PHOTOGRAPH.fullmatch(name) is not None


def read_scanner_app(root: StrPath) -> Scene:
    """Read the frames that have a photograph, with their depth maps; the cloud is empty."""
    root = Path(root)
    names = sorted(path.name for path in root.iterdir())
    records = {Path(name).stem: root / name for name in names if _RECORD.fullmatch(name)}
    photographs = {Path(name).stem: name for name in names if is_photograph(name)}
    used = [name for stem, name in photographs.items() if stem in records]
    first = next(iter(records.values()))
    if not used:
        raise SceneNotFoundError(
            f"photographs of 3D Scanner App's frames, such as {first.with_suffix('.jpg')}",
            found=f"none for {counted(len(records), 'frame')}",
            fix='In the app, share the scan as "All Data" and pass the folder in the archive.',
        )
    findings = without_photograph(len(records) - len(used), len(records), "frame")
    lost = [name for stem, name in photographs.items() if stem not in records]
    findings += left_out("missing-poses", "photograph", "a pose (a .json beside it)", lost)

    def read(name: str) -> PhoneFrame:
        return _read_frame(records[Path(name).stem], photograph_size(root / name))

    scene = read_phone_scene(root, first, root, used, read, findings)
    return scene.replace(depths=match_by_name(scene, root))


def _read_frame(path: Path, size: Size) -> PhoneFrame:
    record = read_record(path, "a frame of 3D Scanner App")
    pose = read_matrix(f"{path}", record, "cameraPoseARFrame", 4, 4)
    K = read_matrix(f"{path}", record, "intrinsics", 3, 3)
    if not np.allclose(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
        raise SceneFormatError(
            f"intrinsics fx 0 cx 0 fy cy 0 0 1, row by row, in {path}",
            found=" ".join(f"{each:g}" for each in K.ravel()),
            fix=EXPORT_AGAIN,
        )
    fx, fy, cx, cy = (float(each) for each in K[[0, 1, 0, 1], [0, 1, 2, 2]])
    pinhole = (fx, fy, cx + HALF_PIXEL, cy + HALF_PIXEL)
    return PhoneFrame(f"{path}", _captured_size(record, K, size), pinhole, pose)


def _captured_size(record: Mapping[str, Any], K: Float64[np.ndarray, "3 3"], size: Size) -> Size:
    """Return the size that K belongs to: the projection matrix has 2 fx / width, 2 fy / height.

    The photograph may be a resized copy. Without such a matrix, its own size is returned.
    """
    try:
        projection = read_matrix("", record, "projectionMatrix", 4, 4)
    except SceneFormatError:
        return size
    scales = projection[[0, 1], [0, 1]]
    if not (scales > _MIN_SCALE).all():
        return size
    captured = 2 * K[[0, 1], [0, 1]] / scales
    width, height = map(round, captured.tolist())
    # For the screen instead of the sensor, the matrix has another shape or is turned.
    turned = (size[0] > size[1]) != (width > height)
    whole = np.abs(captured - np.rint(captured)).max() <= _ROUNDING
    return (width, height) if whole and not turned else size
