"""Meshroom (AliceVision): ``cameras.sfm``, or another SfMData in JSON, with or without structure.

Numbers are strings. ``views`` name a photograph, an intrinsic and a pose; ``poses`` have the centre
and the rotation of ``world_from_cam``, row by row, in OpenCV axes. Of a view of a rig whose
``isPoseIndependant`` is false they are the rig's, and ``rigs`` have ``rig_from_cam``. Before
version 1.2.1 ``principalPoint`` counts from the image corner, then from the centre. Focal lengths
depend on the version, with w the width, s ``sensorWidth``, f ``focalLength`` (mm) and r
``pixelRatio``:

    before 1.2.0   pxFocalLength                before 1.2.5   fx = f w / s,       fy = fx / r
    before 1.2.2   pxFocalLength, x and y       before 1.2.11  fx = f w / s,       fy = r fx
                                                else           fx = f w / (s r),   fy = f w / s

Distortion: radial (k1, or k1 to k3), brown (k1 k2 k3 t1 t2, in OpenCV's convention), fisheye (of
theta^2 to theta^8), fisheye1 (COLMAP's FOV). Sources: AliceVision's ``sfmDataIO/jsonIO.cpp``,
``camera/Distortion*.cpp`` and its files of each version.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.io.camera_records import Lens, brown, fisheye
from splatseed.io.files import read_json
from splatseed.io.photogrammetry import Export, Shot, begins_with, points_of, read_export
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENCV, Scene

_CONVENTION = f"each pose has the rotation of world_from_cam and the centre, {OPENCV}"
_OLD_TYPES = {"radial1": "radialk1", "radial3": "radialk3", "fisheye4": "fisheye"}
"""Names of distortion before version 1.2.8, when ``type`` had them."""
_FALSE = ("false", "0", False)
_Record = Mapping[str, Any]


def find_meshroom(folder: Path) -> list[Path]:
    """List the SfMData files in a folder."""
    return begins_with(folder, "*.sfm", b'"version"')


def read_meshroom(path: Path, root: Path) -> Scene:
    """Read the views that have a pose, and the points if there are any."""
    return read_export(_read, path, root, "Meshroom's SfMData, as JSON")


def _read(path: Path) -> Export:
    content = read_json(path)
    version = tuple(map(int, content["version"]))
    lenses = {each["intrinsicId"]: each for each in content.get("intrinsics", ())}
    poses = {
        each["poseId"]: _matrix(each["pose"]["transform"]) for each in content.get("poses", ())
    }
    rigs = {each["rigId"]: each["subPoses"] for each in content.get("rigs", ())}
    shots, unposed = list[Shot](), list[str]()
    for view in content["views"]:
        name, lens = view["path"], lenses.get(view.get("intrinsicId"))
        pose = poses.get(view.get("poseId"))
        if pose is not None and view.get("isPoseIndependant", "true") in _FALSE:
            within = rigs[view["rigId"]][int(view["subPoseId"])]
            pose = pose @ _matrix(within["pose"]) if within["status"] != "uninitialized" else None
        if pose is None or lens is None:
            unposed.append(name)
            continue
        where, size = f"{path}, view {view['viewId']}", (int(lens["width"]), int(lens["height"]))
        shots.append(Shot(where, name, size, partial(_lens, path, version, lens), pose))
    structure = content.get("structure", ())
    cloud = points_of(
        [list(map(float, each["X"])) for each in structure],
        [list(map(float, each["color"])) for each in structure],
    )
    return Export("meshroom", path, shots, _CONVENTION, unposed, points=cloud)


def _matrix(transform: _Record) -> Float64[np.ndarray, "4 4"]:
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = np.array(transform["rotation"], np.float64).reshape(3, 3)
    world_from_cam[:3, 3] = np.array(transform["center"], np.float64)
    return world_from_cam


def _lens(path: Path, version: tuple[int, ...], record: _Record, size: Size) -> Lens:
    where = f"{path}, intrinsic {record['intrinsicId']}"
    cx, cy = map(float, record["principalPoint"])
    if version >= (1, 2, 1):
        cx, cy = cx + size[0] / 2, cy + size[1] / 2
    focal, center = _focal_lengths(version, record, size[0]), (cx, cy)
    kind, undistortion = record["type"].lower(), record.get("undistortionType", "none")
    if version >= (1, 2, 8) and kind == "pinhole":
        kind = record["distortionType"]
    kind = _OLD_TYPES.get(kind, kind)
    # An empty list is written as "".
    terms = [float(k) for k in record.get("distortionParams") or ()]
    k1, k2, k3, t1, t2 = (*terms, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    if undistortion == "none":
        if kind in {"none", "pinhole", "radialk1", "radialk3", "brown"}:
            return brown(focal, center, (k1, k2, k3), (t1, t2))
        if kind == "fisheye":
            return fisheye(focal, center, terms)
        if kind == "fisheye1":
            return "FOV", (*focal, *center, k1)
    raise SceneFormatError(
        f"a pinhole camera with radial, brown or fisheye distortion in {where}",
        found=kind if undistortion == "none" else undistortion,
        fix="Use the photographs and cameras that Meshroom's node PrepareDenseScene undistorts.",
    )


def _focal_lengths(version: tuple[int, ...], record: _Record, width: int) -> tuple[float, float]:
    if version < (1, 2, 0):
        return (float(record["pxFocalLength"]),) * 2
    if version < (1, 2, 2):
        fx, fy = map(float, record["pxFocalLength"])
        return fx, fy
    f = float(record["focalLength"]) * width / float(record["sensorWidth"])
    ratio = float(record.get("pixelRatio", 1.0))
    if version < (1, 2, 5):
        return f, f / ratio
    return (f, f * ratio) if version < (1, 2, 11) else (f / ratio, f)
