"""OpenSfM and OpenDroneMap: ``reconstruction.json``, also in ODM's folder ``opensfm``.

A list of reconstructions with ``cameras``, ``shots`` and ``points``. A shot has the rotation vector
and the translation of ``cam_from_world`` in OpenCV axes, and is named as its photograph. Cameras
count in units of the longer side, from the image centre. Models: perspective, simple_radial,
radial and brown (OpenCV's k1, k2, p1, p2, k3); fisheye and fisheye_opencv (equidistant, k1 to k4
of theta^2 to theta^8). Sources: OpenSfM's "Geometric Models" and ``opensfm/io.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.camera import rotation_from_quat
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.camera_records import Lens, brown, fisheye, format_error, panorama
from splatseed.io.files import read_json
from splatseed.io.photogrammetry import Export, Shot, points_of, read_export
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENCV, Scene
from splatseed.text import counted

_NAME = "reconstruction.json"
_CONVENTION = f"each shot has the rotation vector and translation of cam_from_world, {OPENCV}"
_PERSPECTIVE = frozenset({"perspective", "simple_radial", "radial", "brown"})
_FISHEYE = frozenset({"fisheye", "fisheye_opencv"})


def find_opensfm(folder: Path) -> list[Path]:
    """Return the reconstruction of OpenSfM's folder, or of ODM's project."""
    places = (folder / _NAME, folder / "opensfm" / _NAME)
    return [path for path in places if path.is_file()][:1]


def read_opensfm(path: Path, root: Path) -> Scene:
    """Read the reconstruction with the most shots, and its points."""
    return read_export(_read, path, root, "OpenSfM's reconstructions, as JSON")


def _read(path: Path) -> Export:
    every = read_json(path)
    if not isinstance(every, list) or not every:
        raise format_error("a list of reconstructions", f"{path}", type(every).__name__)
    chosen = max(every, key=lambda each: len(each["shots"]))
    findings = list[Finding]()
    if len(every) > 1:
        number, total = len(chosen["shots"]), sum(len(each["shots"]) for each in every)
        text = f"{path.name} has {counted(len(every), 'reconstruction')}, each in a frame of its"
        text += f" own: the one with {number} of {counted(total, 'photograph')} is read."
        findings.append(Finding("several-models", text))
    shots = []
    for name, shot in chosen["shots"].items():
        where, camera = f"{path}, shot {name}", chosen["cameras"][shot["camera"]]
        size = int(camera["width"]), int(camera["height"])
        vector = np.array(shot["rotation"], np.float64).reshape(3)
        half = np.linalg.norm(vector) / 2
        # sin(half) / (2 half), also where the vector is 0
        quat = np.array([np.cos(half), *(np.sinc(half / np.pi) / 2 * vector)])
        rotation = rotation_from_quat(quat).T
        center = -rotation @ np.array(shot["translation"], np.float64)
        lens = partial(_lens, f"{path}, camera {shot['camera']}", camera)
        shots.append(
            Shot(
                where, name, size if all(size) else None, lens, np.column_stack([rotation, center])
            )
        )
    points = chosen.get("points", {}).values()
    cloud = points_of(
        [point["coordinates"] for point in points],
        [point.get("color", (128, 128, 128)) for point in points],
    )
    return Export("opensfm", path, shots, _CONVENTION, points=cloud, findings=findings)


def _lens(where: str, camera: Mapping[str, Any], size: Size) -> Lens:
    def number(key: str) -> float:
        return float(camera.get(key, 0.0))

    side, kind = float(max(size)), camera.get("projection_type", "perspective")
    if kind in {"spherical", "equirectangular"}:
        return panorama(*size)
    f = camera.get("focal_x", camera.get("focal"))
    if f is None:
        raise format_error("focal or focal_x", where, "neither")
    focal = float(f) * side, float(camera.get("focal_y", f)) * side
    center = size[0] / 2 + number("c_x") * side, size[1] / 2 + number("c_y") * side
    k1, k2, k3, k4, p1, p2 = map(number, ("k1", "k2", "k3", "k4", "p1", "p2"))
    if kind in _PERSPECTIVE:
        return brown(focal, center, (k1, k2, k3), (p1, p2))
    if kind in _FISHEYE:
        return fisheye(focal, center, (k1, k2, k3, k4))
    raise SceneFormatError(
        f"a perspective or fisheye projection_type in {where}",
        found=repr(kind),
        fix="Undistort the photographs with OpenSfM, and pass its folder undistorted.",
    )
