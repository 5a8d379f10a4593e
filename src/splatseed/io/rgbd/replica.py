"""RGB-D captures in the layout of NICE-SLAM's Replica: colour images, poses and one camera.

A folder holds ``results/frame*.jpg`` (or .png) and ``results/depth*.png``, ``traj.txt`` with one
row-major 4x4 ``world_from_cam`` in OpenCV axes and metres per line, a line per frame in the order
of the frames' numbers, and ``cam_params.json``, here or one folder up.

The layout's principal point counts from the corner of the image, as COLMAP's does. Replica's own
renderer gives OpenGL (w - 1) / 2, so the 1200 pixel wide images have cx = 599.5, half a pixel from
their middle; their depth maps agree with each other there (0.04 mm, and 0.12 with cx = 600).
Promise: every image returned exists, has its camera's size and a rigid, finite pose.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.depth.folder import CAMERA_FILE
from splatseed.io.depth.matching import match_by_name
from splatseed.io.rgbd.capture import (
    check_size,
    find_camera_file,
    read_intrinsics,
    read_text,
)
from splatseed.literal import agreeing, counted
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource

_FRAME = re.compile(r"frame(\d+)\.(?:jpe?g|png)", re.IGNORECASE)
_RIGID_TOLERANCE = 1e-3  # of rotation @ rotation.T against the identity


def load_rgbd(path: Path) -> Scene:
    """Read the images, poses and depth maps of an RGB-D capture; it has no points.

    Frames whose pose is not finite (tracking was lost) are left out and reported in ``warnings``.

    Args:
        path: The folder that holds ``traj.txt`` and ``results/``.

    Returns:
        A scene with posed images, one PINHOLE camera, an empty cloud, and in ``depths`` the
        existing maps (planar z, divided by ``scale`` of ``cam_params.json``).

    Raises:
        SceneNotFoundError: ``traj.txt``, ``cam_params.json`` or the frames are missing.
        SceneFormatError: One of them is not what the layout promises.
    """
    root = Path(path)
    frames = _find_frames(root / "results")
    trajectory = _read_trajectory(root / "traj.txt")
    if len(frames) != len(trajectory):
        raise SceneFormatError(
            f"{root / 'traj.txt'} to have one line per frame, {len(frames)} for {root / 'results'}",
            found=f"{len(trajectory)} lines",
            fix="Put back the missing frames or lines.",
        )
    intrinsics = read_intrinsics(_camera_file(root))
    tracked = np.isfinite(trajectory).all(axis=(1, 2))
    _check_rigid(root / "traj.txt", trajectory, tracked)
    images = tuple(
        _posed_image(frames[i], i + 1, intrinsics, trajectory[i])
        for i in np.flatnonzero(tracked).tolist()
    )
    scene = Scene(
        points=PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)),
        images=images,
        intrinsics=(intrinsics,),
        source=SceneSource("rgbd", root, root / "traj.txt", image_dir=root / "results"),
        warnings=_warnings(frames, tracked),
    )
    return scene.replace(depths=match_by_name(scene, root / "results"))


def _find_frames(folder: Path) -> list[Path]:
    """The colour images of ``folder`` in the order of their numbers."""
    numbers = {
        path: int(match[1])
        for path in (folder.iterdir() if folder.is_dir() else ())
        if (match := _FRAME.fullmatch(path.name))
    }
    if not numbers:
        raise SceneNotFoundError(
            f"images {folder / 'frame000000.jpg'}, ...",
            found="none" if folder.is_dir() else f"no folder {folder}",
            fix="Give the folder that holds traj.txt and results/.",
        )
    return sorted(numbers, key=lambda path: (numbers[path], path.name))


def _read_trajectory(path: Path) -> Float64[np.ndarray, "N 4 4"]:
    """The poses ``world_from_cam`` of all lines, float64 [N, 4, 4]; NaN is kept."""
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path).splitlines(), 1)
        if line.strip()
    ]
    return np.array([_parse_pose(path, number, line) for number, line in lines]).reshape(-1, 4, 4)


def _parse_pose(path: Path, number: int, line: str) -> list[float]:
    try:
        values = [float(word) for word in line.split()]
    except ValueError as error:
        raise _bad_line(path, number, str(error)) from error
    if len(values) != 16:
        raise _bad_line(path, number, f"{len(values)} numbers")
    return values


def _check_rigid(
    path: Path, poses: Float64[np.ndarray, "N 4 4"], which: Bool[np.ndarray, " N"]
) -> None:
    rotation = poses[which, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers are not rigid either
        gram = rotation @ rotation.transpose(0, 2, 1)
        proper = np.linalg.det(rotation) > 0
    rigid = (
        np.isclose(gram, np.eye(3), atol=_RIGID_TOLERANCE).all(axis=(1, 2))
        & proper
        & np.isclose(poses[which, 3], [0, 0, 0, 1], atol=_RIGID_TOLERANCE).all(axis=1)
    )
    if not rigid.all():
        frame = int(np.flatnonzero(which)[np.argmin(rigid)])
        raise SceneFormatError(
            f"pose {frame + 1} of {path} to be a rotation and a translation, last row 0 0 0 1",
            found=np.array2string(poses[frame].ravel(), precision=4, max_line_width=1000),
            fix="Write the rows of world_from_cam one after another, without scale.",
        )


def _bad_line(path: Path, number: int, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"16 numbers, a row-major 4x4 world_from_cam, in {path} line {number}",
        found=found,
        fix="Write one pose per line.",
    )


def _camera_file(root: Path) -> Path:
    path = find_camera_file(root)
    if path is not None:
        return path
    raise SceneNotFoundError(
        f"{CAMERA_FILE} in {root} or the folder above it",
        found="neither",
        fix='Write {"camera": {"w": ..., "h": ..., "fx": ..., "fy": ..., "cx": ..., "cy": ...}}.',
    )


def _posed_image(
    path: Path, image_id: int, intrinsics: Intrinsics, world_from_cam: Float64[np.ndarray, "4 4"]
) -> Image:
    check_size(path, intrinsics)
    cam_from_world_rotation = world_from_cam[:3, :3].T
    return Image(
        name=path.name,
        image_id=image_id,
        intrinsics=intrinsics,
        quat=quat_from_rotation(cam_from_world_rotation),
        translation=-cam_from_world_rotation @ world_from_cam[:3, 3],
    )


def _warnings(frames: list[Path], tracked: Bool[np.ndarray, " N"]) -> tuple[str, ...]:
    lost = [frames[i].name for i in np.flatnonzero(~tracked)]
    if not lost:
        return ()
    are = agreeing(len(lost), "is", "are")
    what = f"{counted(len(lost), 'frame')} without a finite pose"
    return (f"{what} {are} left out, the first is {lost[0]}.",)
