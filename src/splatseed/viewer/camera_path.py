"""Camera paths of nerfstudio's viewer: ``camera_path.json``.

The *path's world* is that of the model that nerfstudio trained. Source: nerfstudio's
``cameras/camera_paths.py``, ``scripts/render.py`` and ``viewer/render_panel.py``: matrices are
``world_from_cam`` in OpenGL axes, fields of view are vertical, in degrees. Keyframes, smoothness
and cycles are how the viewer made the frames; of these all are in the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.camera_records import OPENCV_FROM_OPENGL
from splatseed.io.files import read_bytes, translate_errors
from splatseed.io.regions import Region, turned_box
from splatseed.photos.view import View
from splatseed.photos.visibility import points_in_image
from splatseed.projection import camera_centers
from splatseed.sampling import evenly_spaced
from splatseed.scene import Color
from splatseed.similarity import Similarity
from splatseed.splat.gaussians import Gaussians
from splatseed.text import agreeing, counted
from splatseed.viewer.models import pinhole_view

MAX_FRAMES = 100_000
MAX_SIDE = 8192
"""Pixels."""
_EXPECTED = (
    "a camera path as nerfstudio's viewer writes it: camera_path, with camera_to_world and fov"
)
_FIX = "Export the path again."
_FPS = (0.01, 1000.0)
_MAX_SKEW = 1e-3
_SHAPE_SLACK = 0.01  # relative, of widths for one height
_PERSPECTIVE = "perspective"


@dataclass(frozen=True)
class _PathCheck:
    num_views: int = 60  # sampled from the path
    num_gaussians: int = 5000  # sampled from the model
    min_seen: float = 0.002  # fraction of these that half of the views must see
    max_distance: float = 10.0  # median, relative to the cameras' extent


CHECK = _PathCheck()


class Crop(NamedTuple):
    """The part of the model that a path shows."""

    contains: Region  # of positions in the path's world
    background: Color  # of empty pixels


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A parsed camera path."""

    path: Path
    poses: tuple[Float64[np.ndarray, "4 4"], ...]  # cam_from_path, OpenCV axes
    fovs: tuple[float, ...]  # vertical, radians
    fps: float | None  # frames per second; None: the file does not say
    size: tuple[int, int] | None  # width and height that it is made for
    crop: Crop | None
    shapes: tuple[float, ...] = ()  # width / height that frames state
    timed: bool = False  # frames state different times

    def views(self, size: tuple[int, int], world: Similarity | None = None) -> list[View]:
        """Return the views at a size; ``world`` maps the model's world to the path's."""
        poses = [world.inverse.camera(pose) for pose in self.poses] if world else self.poses
        pairs = zip(self.fovs, poses, strict=True)
        views = [pinhole_view(size, fov, pose) for fov, pose in pairs]
        return [replace(view, name=f"{i:05}.png") for i, view in enumerate(views)]

    def cropped(self, gaussians: Gaussians, world: Similarity | None = None) -> Gaussians:
        """Return the Gaussians whose centres are in the crop box; all without one.

        Raises:
            SceneFormatError: There are none.
        """
        if self.crop is None:
            return gaussians
        xyz = gaussians.means if world is None else world.points(gaussians.means)
        inside = self.crop.contains(xyz)
        if not inside.any():
            raise SceneFormatError(
                f"the crop box of {self.path} to hold a part of the model",
                found=f"none of {len(gaussians):,} Gaussians in it",
                fix="Pass the dataparser_transforms.json of nerfstudio's run as `transform`, or "
                "export the path without Crop Viewport.",
            )
        return gaussians.select(inside)

    def findings(self, size: tuple[int, int], inside: int, total: int) -> list[Finding]:
        """Say how frames of a size differ from those of the path.

        ``inside`` of ``total`` Gaussians are in the crop box.
        """
        found, shape = list[Finding](), size[0] / size[1]
        if self.crop is not None:
            text = f"{self.path} shows {inside:,} of {total:,} Gaussians, those in its crop box."
            found.append(Finding("cropped-path", text, "info"))
        if self.size and max(abs(a - b) for a, b in zip(self.size, size, strict=True)) == 1:
            text = f"Frames are {size[0]} x {size[1]}, not {self.size[0]} x {self.size[1]} as in "
            text += f"{self.path}: H.264 needs even numbers."
            found.append(Finding("path-not-followed", text, "info"))
        if other := [each for each in self.shapes if abs(each / shape - 1) > _SHAPE_SLACK]:
            are = agreeing(len(other), "is", "are")
            text = f"{counted(len(other), 'frame')} of {self.path} {are} made for a width of "
            text += f"{other[0]:.3g} heights; here they are {shape:.3g} heights wide."
            found.append(Finding("path-not-followed", text, "info"))
        if self.timed:
            text = f"Times of {self.path} have no effect: the model does not move."
            found.append(Finding("path-not-followed", text, "info"))
        return found


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path in nerfstudio's JSON.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not a camera path, or not one of perspective cameras.
    """
    with translate_errors(path, _EXPECTED, fix=_FIX):
        return parse_camera_path(path, json.loads(read_bytes(path)))


def parse_camera_path(path: Path, content: Mapping[str, Any]) -> CameraPath:
    """Check the content of a camera path; errors as those of ``read_camera_path``."""
    with translate_errors(path, _EXPECTED, fix=_FIX):
        frames = content["camera_path"]
        _check_types(path, [content, *frames])
        if not 0 < len(frames) <= MAX_FRAMES:
            raise ValueError(counted(len(frames), "camera"))
        times = {frame.get("render_time") for frame in frames}
        return CameraPath(
            path,
            tuple(_pose(i, frame["camera_to_world"]) for i, frame in enumerate(frames)),
            tuple(_fov(i, frame, content) for i, frame in enumerate(frames)),
            _fps(content, len(frames)),
            _size(content),
            None if content.get("crop") is None else _crop(content["crop"]),
            tuple(float(each["aspect"]) for each in frames if each.get("aspect")),
            len(times) > 1,
        )


def check_path(
    path: Path, views: Sequence[View], gaussians: Gaussians, cameras: Sequence[View]
) -> None:
    """Refuse cameras of a file that miss the model or are far from all training cameras."""
    sample = [views[i] for i in evenly_spaced(len(views), CHECK.num_views)]
    xyz = gaussians.means[:: max(1, len(gaussians) // CHECK.num_gaussians)].astype(np.float64)
    seen = [len(points_in_image(view.camera, xyz).depth) / len(xyz) for view in sample]
    lost = np.mean(np.array(seen) < CHECK.min_seen) > 0.5
    if len(cameras) > 1:
        places, there = (
            camera_centers([v.cam_from_world for v in each]) for each in (cameras, sample)
        )
        middle = np.median(places, axis=0)
        reach, away = (np.linalg.norm(each - middle, axis=1) for each in (places, there))
        lost = lost or np.median(away) > CHECK.max_distance * reach.max() > 0
    if lost:
        raise SceneFormatError(
            f"{path} to show the model",
            found="a path through another world, far away or with next to no Gaussians in sight",
            fix="nerfstudio's paths are in a world of its own: pass the dataparser_transforms.json "
            "of its run as `transform`; to use the path unchanged, pass `transform='none'`.",
        )


def is_rotation(pose: Float64[np.ndarray, "4 4"]) -> bool:
    """Whether a pose is finite and rotates without scaling, shearing or mirroring."""
    rotation = pose[:3, :3]
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    return bool(np.isfinite(pose).all() and skew <= _MAX_SKEW and np.linalg.det(rotation) > 0)


def _check_types(path: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Refuse cameras that are not perspective, as the file or a frame of it may say."""
    kinds = {str(record.get("camera_type") or _PERSPECTIVE) for record in records}
    if other := sorted(kind for kind in kinds if kind.lower() != _PERSPECTIVE):
        raise SceneFormatError(
            f"{path} to have cameras of type {_PERSPECTIVE}",
            found=" and ".join(map(repr, other)),
            fix="In nerfstudio's viewer choose the camera type Perspective, then export the path "
            "again.",
        )


def _pose(i: int, rows: Any) -> Float64[np.ndarray, "4 4"]:
    world_from_gl = np.array(rows, np.float64).reshape(4, 4)
    if not is_rotation(world_from_gl):
        raise ValueError(f"camera {i}, whose matrix is no rotation")
    return np.asarray(np.linalg.inv(world_from_gl @ OPENCV_FROM_OPENGL))


def _fov(i: int, frame: Mapping[str, Any], content: Mapping[str, Any]) -> float:
    degrees = frame.get("fov", content.get("default_fov", 50))
    fov = math.radians(float(degrees))
    if not 0 < fov < math.pi:
        raise ValueError(f"camera {i} with a field of view of {degrees}")
    return fov


def _fps(content: Mapping[str, Any], frames: int) -> float | None:
    """Frames per second: as nerfstudio renders, by the length in seconds if there is one."""
    seconds, fps = content.get("seconds"), content.get("fps")
    fps = frames / float(seconds) if seconds else float(fps) if fps else None
    if fps is not None and not _FPS[0] <= fps <= _FPS[1]:
        raise ValueError(f"{fps:g} frames a second")
    return fps


def _size(content: Mapping[str, Any]) -> tuple[int, int] | None:
    width, height = (content.get(f"render_{side}") for side in ("width", "height"))
    if width is None or height is None:
        return None
    size = int(width), int(height)
    if not all(0 < side <= MAX_SIDE for side in size):
        raise ValueError(f"frames of {width} x {height} pixels")
    return size


def _crop(crop: Mapping[str, Any]) -> Crop:
    turn = crop.get("crop_rot") or (0.0, 0.0, 0.0)  # roll, pitch and yaw, radians
    center, sides, angles = (
        np.array(each, np.float64).reshape(3)
        for each in (crop["crop_center"], crop["crop_scale"], turn)
    )
    colour = crop.get("crop_bg_color") or dict.fromkeys("rgb", 0)
    background = np.array([colour[channel] for channel in "rgb"], np.float64)
    numbers = np.concatenate([center, sides, angles, background])
    if not np.isfinite(numbers).all() or not (sides > 0).all():
        raise ValueError(f"a crop box of {sides.tolist()} at {center.tolist()}")
    box = np.eye(4)
    box[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix() * sides  # yaw @ pitch @ roll
    box[:3, 3] = center
    red, green, blue = np.clip(np.rint(background), 0, 255).astype(int).tolist()
    return Crop(turned_box(box), (red, green, blue))
