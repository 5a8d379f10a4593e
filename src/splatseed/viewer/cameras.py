"""Given cameras, to be rendered each at its size: those of a scene or of a file of cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from splatseed.camera import Camera
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.exclusion import EXCLUDED, exclude
from splatseed.io.files import IMAGE_SUFFIXES, read_json, translate_errors
from splatseed.io.origin import find_shift
from splatseed.photos.view import NO_PIXELS, View, camera_views
from splatseed.projection import camera_centers
from splatseed.scene import Scene
from splatseed.similarity import Similarity
from splatseed.splat.pictures import picture_names
from splatseed.text import agreeing, counted
from splatseed.viewer.camera_path import MAX_SIDE, CameraPath, is_rotation, parse_camera_path

SHAPE = (960, 720)
"""Width and height of the frames of a path that has no size."""
_ABOUT_POSES = ("unusable-images", "bad-frames", "duplicate-frames", "ignored-distortion", EXCLUDED)
"""Findings of a scene that concern its cameras as they are rendered."""


@dataclass(frozen=True, eq=False)
class GivenCameras:
    """Cameras with the names of their pictures, which are unique."""

    views: tuple[View, ...]
    of_scene: bool
    """Whether they are in the scene's world; else in that of the model as its file has it."""
    findings: tuple[Finding, ...] = ()
    path: CameraPath | None = None

    def moved(self, world: Similarity | None) -> list[View]:
        """Return the views in the model's world, which ``world`` maps to theirs."""
        if world is None:
            return list(self.views)
        return [view.posed(world.inverse.camera(view.cam_from_world)) for view in self.views]


def is_scene(path: Path) -> bool:
    """Whether cameras are those of a scene: not a camera path or graphdeco's ``cameras.json``."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return True
    content = read_json(path)
    return isinstance(content, dict) and "camera_path" not in content


def read_cameras(
    path: Path, known: Scene | None = None, excluded: Sequence[str] = ()
) -> GivenCameras:
    """Read the cameras of a scene, of graphdeco's ``cameras.json`` or of a camera path.

    Those of a scene are moved to the origin of the ``known`` one, and keep the size of their
    photograph, or without one that of the file; without those that ``excluded`` names.

    Raises:
        SceneNotFoundError: There is nothing.
        SceneFormatError: It is malformed or has no cameras.
    """
    if is_scene(path):
        return _cameras_of_scene(path, known, excluded)
    content = read_json(path)
    if isinstance(content, list):
        return GivenCameras(tuple(_graphdeco_cameras(path, content)), of_scene=False)
    parsed = parse_camera_path(path, content)
    size = parsed.size or SHAPE
    return GivenCameras(tuple(parsed.views(size)), of_scene=False, path=parsed)


def _cameras_of_scene(path: Path, known: Scene | None, excluded: Sequence[str]) -> GivenCameras:
    same = known is not None and known.source.named == path.absolute()
    scene = known if known is not None and same else load_scene(path, require_points=False)
    scene = exclude(scene, excluded)
    if not scene.images:
        raise SceneFormatError(
            f"cameras in {path}",
            found="points alone" if len(scene.points) else "none",
            fix="Name a COLMAP model, a transforms.json, graphdeco's cameras.json or a camera path "
            "of nerfstudio.",
        )
    views = camera_views(scene.images)
    if known is not None and not same:
        centers = camera_centers([view.cam_from_world for view in views])
        shift = find_shift(known, centers, scene.offset, unrecorded=True)
        if shift.any():
            by = Similarity(1.0, np.eye(3), shift)
            views = tuple(view.posed(by.camera(view.cam_from_world)) for view in views)
    findings = [each for each in scene.findings if each.kind in _ABOUT_POSES]
    if bent := [image.name for image in scene.images if image.intrinsics.has_distortion]:
        have = agreeing(len(bent), "has", "have")
        text = f"{counted(len(bent), 'camera')} of {path} {have} lens distortion, which is left "
        text += "out: renders are those of pinhole cameras."
        findings.append(Finding("ignored-distortion", text, subjects=tuple(bent)))
    return GivenCameras(tuple(_named(views)), of_scene=True, findings=tuple(findings))


def _graphdeco_cameras(path: Path, records: Sequence[Mapping[str, Any]]) -> list[View]:
    """Cameras of 3DGS's reference code (``utils/camera_utils.py: camera_to_JSON``).

    ``rotation`` is that of ``world_from_cam`` in OpenCV axes, ``position`` the centre. The
    principal point is the middle of the image.
    """
    what = "cameras as graphdeco's trainer writes them: width, height, fx, fy, position, rotation"
    with translate_errors(path, what, fix="Take the cameras.json of the trained model."):
        views = []
        for i, record in enumerate(records):
            size = width, height = int(record["width"]), int(record["height"])
            fx, fy = float(record["fx"]), float(record["fy"])
            pose = np.eye(4)
            pose[:3, :3] = np.array(record["rotation"], np.float64).reshape(3, 3)
            pose[:3, 3] = np.array(record["position"], np.float64).reshape(3)
            good = all(0 < side <= MAX_SIDE for side in size) and min(fx, fy) > 0
            if not (good and np.isfinite([fx, fy]).all() and is_rotation(pose)):
                raise ValueError(f"camera {i} of {width} x {height}, fx {fx:g}, fy {fy:g}")
            K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1.0]])
            camera = Camera(K, width, height, np.linalg.inv(pose))
            views.append(View(str(record.get("img_name", f"{i:05}")), NO_PIXELS, camera))
        if not views:
            raise ValueError("no camera")
    return _named(views)


def _named(views: Sequence[View]) -> list[View]:
    """Name views by their pictures, one each."""
    names = [
        view.name if view.name.lower().endswith(IMAGE_SUFFIXES) else f"{view.name}.png"
        for view in views
    ]
    count = Counter(names)  # older versions of graphdeco's code leave out folders
    names = [f"{i:05}_{PurePath(n).name}" if count[n] > 1 else n for i, n in enumerate(names)]
    pictures = picture_names(names)
    return [
        View(pictures[name], NO_PIXELS, view.camera)
        for name, view in zip(names, views, strict=True)
    ]
