"""OpenMVG's ``sfm_data.json``: views, intrinsics, extrinsics and structure.

Lists of ``key`` and ``value``, in which objects stand in ``ptr_wrapper: data``. An extrinsic has
the rotation (rows) of ``cam_from_world`` and the centre, in OpenCV axes. An intrinsic has
``focal_length`` and ``principal_point`` in pixels from the image corner, and the distortion of its
type: ``disto_k1`` or ``disto_k3`` (of r^2 to r^6), ``disto_t2`` (k1 k2 k3 t1 t2, in OpenCV's
convention) or ``fisheye`` (of theta^2 to theta^8). The structure's points ``X`` have no colours.
Sources: OpenMVG's "SfM output format" and ``cameras/Camera_Pinhole*_io.hpp``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.io.camera_records import Lens, brown, fisheye, format_error, panorama
from splatseed.io.files import read_json
from splatseed.io.photogrammetry import Export, Shot, begins_with, points_of, read_export
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENCV, Scene

_CONVENTION = f"each extrinsic has the rotation of cam_from_world and the centre, {OPENCV}"
_HEAD = b'"sfm_data_version"'
_Record = Mapping[str, Any]


def find_openmvg(folder: Path) -> list[Path]:
    """List OpenMVG's scenes in a folder."""
    return begins_with(folder, "*sfm*.json", _HEAD)


def read_openmvg(path: Path, root: Path) -> Scene:
    """Read the views that have a pose, and the points, which are grey."""
    return read_export(_read, path, root, "OpenMVG's scene, as JSON")


def _read(path: Path) -> Export:
    content = read_json(path)
    poses, cameras = (
        {each["key"]: each["value"] for each in content.get(key, ())}
        for key in ("extrinsics", "intrinsics")
    )
    shots, unposed = list[Shot](), list[str]()
    for each in content["views"]:
        view = each["value"]["ptr_wrapper"]["data"]
        view = view.get("value0", view)  # of a view with a position prior
        where, name = f"{path}, view {each['key']}", _path(content, view)
        pose, camera = poses.get(view["id_pose"]), cameras.get(view["id_intrinsic"])
        if pose is None or camera is None:
            unposed.append(name)
            continue
        data = camera["ptr_wrapper"]["data"]
        whole = data.get("value0", data)  # of a panorama
        size = int(whole["width"]), int(whole["height"])
        rotation = np.array(pose["rotation"], np.float64).reshape(3, 3).T
        center = np.array(pose["center"], np.float64).reshape(3)
        lens = partial(_lens, f"{path}, intrinsic {view['id_intrinsic']}", data)
        shots.append(Shot(where, name, size, lens, np.column_stack([rotation, center])))
    structure = [each["value"]["X"] for each in content.get("structure", ())]
    return Export("openmvg", path, shots, _CONVENTION, unposed, points=points_of(structure, None))


def _path(content: _Record, view: _Record) -> str:
    parts = [content.get("root_path", ""), view.get("local_path", ""), view["filename"]]
    return "/".join(str(part).replace("\\", "/").rstrip("/") for part in parts if part)


def _lens(where: str, data: _Record, size: Size) -> Lens:
    if "focal_length" not in data:
        if "value0" in data or len(data) == 2:
            return panorama(*size)
        raise format_error("a focal_length", where, "none")
    f, (cx, cy) = float(data["focal_length"]), map(float, data["principal_point"])
    focal, center = (f, f), (cx, cy)
    if "fisheye" in data:
        return fisheye(focal, center, [float(k) for k in data["fisheye"]])
    terms = next((data[key] for key in ("disto_k1", "disto_k3", "disto_t2") if key in data), ())
    k1, k2, k3, t1, t2 = (*map(float, terms), 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return brown(focal, center, (k1, k2, k3), (t1, t2))
