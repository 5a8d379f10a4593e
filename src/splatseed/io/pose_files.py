"""Folders with a text file per pose: 7-Scenes' ``frame-N.pose.txt``, and ScanNet's ``pose/N.txt``.

A file holds ``world_from_cam``, four rows of four numbers, in OpenCV axes and metres; -inf in
ScanNet where tracking was lost. Photographs are ``frame-N.color.png`` beside, or ``color/N.jpg``.
Cameras: ScanNet's ``intrinsic/intrinsic_color.txt`` (4 x 4, pixels from the centre of the first),
else ``cam_params.json`` as in an RGB-D capture, else a Kinect's focal length and the image centre,
as 7-Scenes publishes no calibration of its colour camera. ScanNet's ``depth/N.png`` (planar z,
millimetres) is registered to the photographs, 7-Scenes' depth is not. Sources: both data sets'
pages of file formats.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.camera_records import Lens, format_error, left_out
from splatseed.io.depth_maps import camera_file, match_by_name
from splatseed.io.files import StrPath, image_names, is_data, numbered_lines
from splatseed.io.photogrammetry import Export, Shot, make_scene
from splatseed.io.photograph_checks import Size
from splatseed.io.rgbd import read_camera_file
from splatseed.scene import OPENCV, Scene
from splatseed.text import counted

_CONVENTION = f"each pose file holds world_from_cam, {OPENCV}"
_POSE, _COLOR = ".pose", ".color"
_HALF_PIXEL = 0.5
_KINECT = 525 / 640
"""Focal length of a Kinect's colour camera, in image widths: ROS's default."""


def is_pose_folder(folder: Path) -> bool:
    """Whether a folder has a pose file of either layout."""
    return next(folder.glob(f"*{_POSE}.txt"), None) is not None or _is_scannet(folder)


def _is_scannet(folder: Path) -> bool:
    named = (folder / "pose").is_dir() and (folder / "color").is_dir()
    return named and next((folder / "pose").glob("*.txt"), None) is not None


def read_pose_folder(root: StrPath) -> Scene:
    """Read the photographs that have a finite pose; the cloud is empty."""
    root = Path(root)
    scannet = _is_scannet(root)
    folder, poses = (root / "color", root / "pose") if scannet else (root, root)
    marks = ("", "") if scannet else (_COLOR, _POSE)
    files = {path.stem.removesuffix(marks[1]): path for path in poses.glob(f"*{marks[1]}.txt")}
    names = [name for name in image_names(folder) if Path(name).stem.endswith(marks[0])]
    posed = {name: files.get(Path(name).stem.removesuffix(marks[0])) for name in names}
    if not any(posed.values()):
        example = min(files.values()).name.removesuffix(f"{marks[1]}.txt") + f"{marks[0]}.jpg"
        raise SceneNotFoundError(
            f"photographs in {folder}, such as {example}",
            found=f"none for {counted(len(files), 'pose')}",
            fix="Copy them there.",
        )
    size, lens, findings = _camera(root)
    shots, unposed = list[Shot](), list[str]()
    for name, path in posed.items():
        pose = None if path is None else _read_matrix(path)
        if pose is None or not np.isfinite(pose).all():
            unposed.append(name)
        else:
            shots.append(Shot(f"{path}", name, size, lens, pose))
    bare = sorted({*files} - {Path(name).stem.removesuffix(marks[0]) for name in names})
    findings += left_out("missing-photographs", "pose", "a photograph", bare)
    track = next(path for path in posed.values() if path is not None)
    export = Export("poses", track, shots, _CONVENTION, unposed, folder=folder, findings=findings)
    scene = make_scene(export, root)
    return scene.replace(depths=match_by_name(scene, root)) if scannet else scene


def _camera(root: Path) -> tuple[Size | None, Callable[[Size], Lens], list[Finding]]:
    """Return the size that the camera belongs to, if known, and a finding if it is a guess."""
    stated = root / "intrinsic/intrinsic_color.txt"
    if stated.is_file():
        fx, fy, cx, cy = _read_matrix(stated)[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        lens = "PINHOLE", (fx, fy, cx + _HALF_PIXEL, cy + _HALF_PIXEL)
        return None, lambda _: lens, []
    if (path := camera_file(root)) is not None:
        camera = read_camera_file(path)
        known = camera.model, camera.params
        return (camera.width, camera.height), lambda _: known, []
    text = f"{root} has no cam_params.json: a Kinect's focal length of 525 in 640 pixels and a"
    text += " central principal point are assumed."
    return None, _kinect, [Finding("assumed-intrinsics", text)]


def _kinect(size: Size) -> Lens:
    focal = _KINECT * max(size)
    return "PINHOLE", (focal, focal, size[0] / 2, size[1] / 2)


def _read_matrix(path: Path) -> Float64[np.ndarray, "4 4"]:
    """Read 16 numbers; ``-inf`` and ``nan`` are numbers."""
    fields = [field for _, line in numbered_lines(path) if is_data(line) for field in line.split()]
    try:
        numbers = np.array([float(field) for field in fields], np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 16:
        raise format_error("4 rows of 4 numbers", f"{path}", " ".join(fields)[:80] or "none")
    return numbers.reshape(4, 4)
