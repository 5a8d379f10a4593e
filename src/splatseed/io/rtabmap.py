"""RTAB-Map: what ``rtabmap-export --images_id --poses_camera NAME.db`` writes.

``NAME_camera_poses.txt`` has a line per node, ``timestamp x y z qx qy qz qw id``:
``world_from_cam`` in OpenCV axes, metres, z up. ``NAME_rgb/ID.jpg`` are the photographs (with
``--images`` they are named by the time stamp), ``NAME_calib/ID.yaml`` their cameras as OpenCV
writes them, pixels from the centre of the first, and ``NAME_depth/ID.png`` planar z in millimetres.
Sources: RTAB-Map's
``tools/Export/main.cpp``, ``corelib/src/Graph.cpp`` and ``CameraModel.cpp``.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.camera import rotation_from_quat
from splatseed.errors import SceneFormatError
from splatseed.io.camera_records import Lens, brown, check_unit_quat, fisheye, format_error
from splatseed.io.depth_maps import DepthFiles
from splatseed.io.files import image_names, is_data, numbered_lines, read_bytes, translate_errors
from splatseed.io.photogrammetry import EXPORT_AGAIN, Export, Shot, begins_with, make_scene
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENCV, Scene

_CONVENTION = f"each line has the position and quaternion of world_from_cam, {OPENCV}"
_SUFFIX = "_camera_poses.txt"
_HALF_PIXEL = 0.5
_DEPTH_SCALE = 1000.0
"""Stored units per metre."""


def find_rtabmap(folder: Path) -> list[Path]:
    """List files of camera poses with ids."""
    return begins_with(folder, f"*{_SUFFIX}", b"#timestamp x y z qx qy qz qw id")


def read_rtabmap(path: Path, root: Path) -> Scene:
    """Read the photographs that have a pose, with their depth maps; the cloud is empty."""
    name = path.name.removesuffix(_SUFFIX)
    folder, calibrations = (path.with_name(f"{name}_{each}") for each in ("rgb", "calib"))
    poses = dict[str, tuple[str, Float64[np.ndarray, "3 4"]]]()
    for where, line in numbered_lines(path):
        if is_data(line):
            stamp, pose, node = _record(where, line.split())
            poses[node] = poses[stamp] = where, pose
    shots, unposed = list[Shot](), list[str]()
    for photograph in image_names(folder):
        stem = Path(photograph).stem
        if stem not in poses:
            unposed.append(photograph)
            continue
        where, pose = poses[stem]
        lens = partial(_lens, calibrations / f"{stem}.yaml")
        shots.append(Shot(where, photograph, None, lens, pose))
    export = Export("rtabmap", path, shots, _CONVENTION, unposed, folder=folder)
    scene = make_scene(export, root)
    maps = path.with_name(f"{name}_depth")
    paths = {im.name: maps / f"{Path(im.name).stem}.png" for im in scene.images}
    paths = {photograph: each for photograph, each in paths.items() if each.is_file()}
    return scene.replace(depths=DepthFiles(paths, "z", _DEPTH_SCALE) if paths else None)


def _record(where: str, fields: list[str]) -> tuple[str, Float64[np.ndarray, "3 4"], str]:
    """Return the time stamp, ``world_from_cam`` and the id of a line."""
    try:
        stamp, *numbers, node = fields
        pose = np.array([float(each) for each in numbers], np.float64)
    except ValueError:
        pose = np.zeros(0)
    if len(pose) != 7:
        raise format_error("timestamp x y z qx qy qz qw id", where, " ".join(fields)[:80])
    quat = pose[[6, 3, 4, 5]]
    if not np.isfinite(pose).all():
        return stamp, np.full((3, 4), np.nan), node
    check_unit_quat(quat, where, EXPORT_AGAIN)
    return stamp, np.column_stack([rotation_from_quat(quat), pose[:3]]), node


def _lens(path: Path, size: Size) -> Lens:
    with translate_errors(path, "the camera of a photograph, as OpenCV's YAML", fix=EXPORT_AGAIN):
        text = read_bytes(path).decode("utf-8")
        width, height = (int(_field(text, key)) for key in ("image_width", "image_height"))
        fx, _, cx, _, fy, cy, *_ = _numbers(text, "camera_matrix")
        terms = _numbers(text, "distortion_coefficients")
        model = _field(text, "distortion_model").strip('"')
    if (width, height) != size:
        raise SceneFormatError(
            f"the camera of a photograph of {size[0]} x {size[1]} pixels in {path}",
            found=f"{width} x {height}",
            fix=EXPORT_AGAIN,
        )
    focal, center = (fx, fy), (cx + _HALF_PIXEL, cy + _HALF_PIXEL)
    if model == "equidistant":
        return fisheye(focal, center, terms)
    k1, k2, p1, p2, k3, *denominator = (*terms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)[:8]
    if any(denominator):
        return "FULL_OPENCV", (*focal, *center, k1, k2, p1, p2, k3, *denominator)
    return brown(focal, center, (k1, k2, k3), (p1, p2))


def _field(text: str, key: str) -> str:
    found = re.search(rf"^{key}:\s*(\S+)", text, re.MULTILINE)
    if found is None:
        raise ValueError(f"no {key}")
    return found[1]


def _numbers(text: str, key: str) -> list[float]:
    found = re.search(rf"^{key}:.*?data:\s*\[(.*?)\]", text, re.MULTILINE | re.DOTALL)
    if found is None:
        raise ValueError(f"no {key}")
    return [float(each) for each in found[1].split(",")]
