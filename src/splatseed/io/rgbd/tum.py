"""RGB-D captures in the layout of TUM's RGB-D benchmark.

A folder holds ``rgb.txt`` and ``depth.txt`` (``time path`` a line, times in seconds),
``groundtruth.txt`` (``time tx ty tz qx qy qz qw`` a line, ``world_from_cam`` in OpenCV axes and
metres) and the images, in ``rgb/`` and ``depth/``; depth PNGs hold planar z times 5000. Lines that
begin with # are comments.

Notation: measurements at different times belong together if the times are within 0.02 s, the
benchmark's own tolerance. Promise: every image returned exists, has its camera's size and a pose.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics, rotation_from_quat
from splatseed.errors import SceneNotFoundError
from splatseed.io.colmap.scene import empty_cloud
from splatseed.io.depth.files import DepthFiles
from splatseed.io.depth.folder import read_capture_scale, safe_parts
from splatseed.io.depth.lens import Undistortion
from splatseed.io.image_checks import lens_warnings
from splatseed.io.rgbd.capture import check_size, find_camera_file, read_intrinsics
from splatseed.io.rgbd.tum_lists import TOLERANCE, nearest_in_time, poses_at, read_list, read_track
from splatseed.literal import agreeing, counted
from splatseed.scene import Image, Scene, SceneSource

DEPTH_SCALE = 5000.0
"""Stored units per metre."""

_SIZE = (640, 480)
_SERIES = re.compile(r"(?:freiburg|(?<![a-z])fr)_?([123])(?!\d)", re.IGNORECASE)
_COLOR_CAMERAS: dict[str, tuple[float, ...]] = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""fx fy cx cy k1 k2 p1 p2 k3 of the colour cameras, as the benchmark's page "File formats" gives
them (the images of freiburg3 are undistorted already). The first pixel's centre is (0, 0) there."""
_DEFAULT_CAMERA = (525.0, 525.0, 319.5, 239.5)  # ROS's, which that page gives too


def is_tum(root: Path) -> bool:
    """Whether a folder has this layout's lists."""
    return (root / "rgb.txt").is_file() and (root / "groundtruth.txt").is_file()


def load_tum(path: Path) -> Scene:
    """Read the images, poses and depth maps of a TUM RGB-D capture; it has no points.

    The camera is that of ``cam_params.json`` (here or one folder up, as in NICE-SLAM's layout),
    else the published one of the series in the folder's name (freiburg1, 2 or 3), else ROS's
    default, with a warning. A pose is interpolated between the records before and after the image
    if both are near, else it is the nearest record's. Images without a pose or a file are left out
    with a warning.

    Args:
        path: The folder that holds ``rgb.txt`` and ``groundtruth.txt``.

    Returns:
        A scene with posed images, one PINHOLE or FULL_OPENCV camera, an empty cloud, and in
        ``depths`` the maps nearest in time.

    Raises:
        SceneNotFoundError: A list is missing, or no image has a pose.
        SceneFormatError: A file is not what the layout promises.
    """
    root = Path(path)
    times, names = read_list(root / "rgb.txt")
    intrinsics, guessed = _camera(root)
    quats, centers, near = poses_at(read_track(root / "groundtruth.txt"), times)
    present = np.array([(root / name).is_file() for name in names], bool)
    used = np.flatnonzero(near & present).tolist()
    if not used:
        raise SceneNotFoundError(
            f"images of {root / 'rgb.txt'} with a pose in groundtruth.txt within {TOLERANCE} s",
            found=f"{int(present.sum())} of {len(names)} images, {int(near.sum())} with a pose",
            fix="Put the images back, and check that both files count time alike.",
        )
    folder = _common_folder(names)
    images = tuple(
        _image(root, folder, names[i], i + 1, intrinsics, quats[i], centers[i]) for i in used
    )
    scene = Scene(
        empty_cloud(),
        images,
        (intrinsics,),
        source=SceneSource("rgbd", root, root / "groundtruth.txt", image_dir=root / folder),
        warnings=(
            *guessed,
            *_left_out("a pose close in time", [names[i] for i in np.flatnonzero(~near)]),
            *_left_out("a file", [names[i] for i in np.flatnonzero(near & ~present)]),
            *lens_warnings(images),
        ),
    )
    return scene.replace(depths=find_tum_depths(scene, root))


def find_tum_depths(scene: Scene, root: Path) -> DepthFiles | None:
    """The maps nearest in time to the images of a scene that was made from a capture.

    Where the capture's lens is distorted and the scene's photographs are not the capture's own, as
    ``splatseed sfm`` and COLMAP undistort them, the maps are undistorted likewise.

    Args:
        scene: Its images are named as those of ``rgb.txt``, by the last part of their paths.
        root: The capture.

    Returns:
        The maps, planar z; None where no image has one.

    Raises:
        SceneFormatError: A list is not what the layout promises.
    """
    if not (root / "depth.txt").is_file():
        return None
    times, names = read_list(root / "rgb.txt")
    depth_times, depth_names = read_list(root / "depth.txt")
    nearest = nearest_in_time(depth_times, times)
    entries = {PurePosixPath(name).name: i for i, name in enumerate(names) if nearest[i] >= 0}
    paths: dict[str, Path] = {}
    for image in scene.images:
        entry = entries.get(safe_parts(image.name)[-1])
        if entry is not None and (path := root / depth_names[nearest[entry]]).is_file():
            paths[image.name] = path
    camera_file = find_camera_file(root)
    scale = read_capture_scale(camera_file) if camera_file else None
    originals = {name: root / names[entries[safe_parts(name)[-1]]] for name in paths}
    lens = _undistortion(scene, _camera(root)[0], originals)
    return DepthFiles(paths, "z", scale or DEPTH_SCALE, lens) if paths else None


def _camera(root: Path) -> tuple[Intrinsics, tuple[str, ...]]:
    """The capture's camera, and a warning if it is a guess."""
    path = find_camera_file(root)
    if path is not None:
        return read_intrinsics(path), ()
    series = _SERIES.search(root.name) or _SERIES.search(root.resolve().name)
    if series is None:
        told = (
            f"{root} has no cam_params.json and no freiburg1, 2 or 3 in its name: focal length 525"
        )
        return _intrinsics(_DEFAULT_CAMERA), (f"{told} and the middle of the image are assumed.",)
    return _intrinsics(_COLOR_CAMERAS[series[1]]), ()


def _intrinsics(published: tuple[float, ...]) -> Intrinsics:
    fx, fy, cx, cy, *distortion = published
    pinhole = (fx, fy, cx + 0.5, cy + 0.5)
    if not distortion:
        return Intrinsics(1, "PINHOLE", *_SIZE, pinhole)
    return Intrinsics(1, "FULL_OPENCV", *_SIZE, (*pinhole, *distortion, 0.0, 0.0, 0.0))


def _undistortion(
    scene: Scene, lens: Intrinsics, originals: dict[str, Path]
) -> Undistortion | None:
    """Moves maps to the scene's photographs; None if those are the capture's own."""
    posed = {image.name: image.intrinsics for image in scene.images if image.name in originals}
    if lens.is_pinhole or not all(camera.is_pinhole for camera in posed.values()):
        return None
    folder = scene.source.image_dir if scene.source else None
    first = next(iter(originals), None)
    if folder is not None and first is not None and _is_copy(folder / first, originals[first]):
        return None
    return Undistortion(lens, posed)


def _is_copy(path: Path, original: Path) -> bool:
    return path.is_file() and original.is_file() and path.read_bytes() == original.read_bytes()


def _image(
    root: Path,
    folder: PurePosixPath,
    path: str,
    image_id: int,
    intrinsics: Intrinsics,
    quat: Float64[np.ndarray, " 4"],
    center: Float64[np.ndarray, " 3"],
) -> Image:
    """An image, checked, from its ``world_from_cam``; its name is relative to ``folder``."""
    check_size(root / path, intrinsics)
    quat = quat * [1, -1, -1, -1]  # the inverse rotation
    name = str(PurePosixPath(path).relative_to(folder))
    return Image(name, image_id, intrinsics, quat, -rotation_from_quat(quat) @ center)


def _common_folder(names: Sequence[str]) -> PurePosixPath:
    """The folder that all images lie in, which their names omit."""
    folders = {PurePosixPath(name).parent for name in names}
    return folders.pop() if len(folders) == 1 else PurePosixPath()


def _left_out(lacking: str, names: Sequence[str]) -> tuple[str, ...]:
    if not names:
        return ()
    are = agreeing(len(names), "is", "are")
    what = f"{counted(len(names), 'image')} without {lacking}"
    return (f"{what} {are} left out, the first is {names[0]}.",)
