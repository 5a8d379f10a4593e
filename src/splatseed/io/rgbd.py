"""RGB-D captures: NICE-SLAM's layout of Replica, and TUM's RGB-D benchmark (also 7-Scenes').

Replica: ``results/frame*.jpg`` (or .png) and ``results/depth*.png``, ``traj.txt`` with one
row-major 4x4 ``world_from_cam`` in OpenCV axes and metres per line, a line per frame in the order
of the frames' numbers, and ``cam_params.json``, here or one folder up. The principal point counts
from the corner of the image, as COLMAP's does: Replica's own renderer gives OpenGL (w - 1) / 2, so
the 1200 pixel wide images have cx = 599.5, half a pixel from their middle; their depth maps agree
with each other there (0.04 mm, and 0.12 with cx = 600).

TUM: ``rgb.txt`` and ``depth.txt`` (``time path`` a line, times in seconds), ``groundtruth.txt``
(``time tx ty tz qx qy qz qw`` a line, ``world_from_cam`` in OpenCV axes and metres) and the images;
depth PNGs hold planar z times 5000. Lines that begin with # are comments. Measurements at different
times belong together if the times are within 0.02 s, the benchmark's own tolerance.

Promise: every image returned exists, has its camera's size and a rigid, finite pose; every failure
names the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatseed.camera import Intrinsics, quat_from_rotation, rotation_from_quat
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.depth_maps import (
    CAMERA_FILE,
    DepthFiles,
    Undistortion,
    match_by_name,
    read_capture_scale,
    safe_parts,
)
from splatseed.io.files import guarded, open_file, read_bytes, read_json
from splatseed.io.photograph import lens_warnings
from splatseed.literal import agreeing, counted
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource

_FRAME = re.compile(r"frame(\d+)\.(?:jpe?g|png)", re.IGNORECASE)
_RIGID_TOLERANCE = 1e-3  # of rotation @ rotation.T against the identity
_TOLERANCE = 0.02
"""Seconds by which an image, its depth and its pose may differ."""
_NORM_SLACK = 0.01  # of a quaternion, which is written with four digits
_DEPTH_SCALE = 5000.0
"""TUM's stored units per metre."""
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


def load_rgbd(path: Path) -> Scene:
    """Read the images, poses and depth maps of a capture in Replica's layout; it has no points.

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
    folder, track = root / "results", root / "traj.txt"
    there = [(m, p) for p in _list(folder) if (m := _FRAME.fullmatch(p.name))]
    frames = [p for m, p in sorted(there, key=lambda each: (int(each[0][1]), each[1].name))]
    if not frames:
        raise SceneNotFoundError(
            f"images {folder / 'frame000000.jpg'}, ...",
            found="none" if folder.is_dir() else f"no folder {folder}",
            fix="Give the folder that holds traj.txt and results/.",
        )
    poses = _read_trajectory(track)
    if len(frames) != len(poses):
        raise SceneFormatError(
            f"{track} to have one line per frame, {len(frames)} for {folder}",
            found=f"{len(poses)} lines",
            fix="Put back the missing frames or lines.",
        )
    camera_file = _camera_file(root)
    if camera_file is None:
        raise SceneNotFoundError(
            f"{CAMERA_FILE} in {root} or the folder above it",
            found="neither",
            fix='Write {"camera": {"w": 9, "h": 9, "fx": 9, "fy": 9, "cx": 9, "cy": 9}}.',
        )
    intrinsics = _read_intrinsics(camera_file)
    tracked = np.isfinite(poses).all(axis=(1, 2))
    _check_rigid(track, poses, tracked)
    images = []
    for i in np.flatnonzero(tracked).tolist():
        _check_image(frames[i], intrinsics)
        rotation = poses[i, :3, :3].T
        quat, translation = quat_from_rotation(rotation), -rotation @ poses[i, :3, 3]
        images.append(Image(frames[i].name, i + 1, intrinsics, quat, translation))
    lost = [frames[i].name for i in np.flatnonzero(~tracked)]
    scene = Scene(
        points=PointCloud.empty(),
        images=tuple(images),
        intrinsics=(intrinsics,),
        source=SceneSource("rgbd", root, track, image_dir=folder),
        warnings=_left_out("frame", "a finite pose", lost),
    )
    return scene.replace(depths=match_by_name(scene, folder))


def is_tum(root: Path) -> bool:
    """Whether a folder has the lists of TUM's layout."""
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
    times, names = _read_list(root / "rgb.txt")
    intrinsics, guessed = _tum_camera(root)
    quats, centers, near = _poses_at(_read_track(root / "groundtruth.txt"), times)
    present = np.array([(root / name).is_file() for name in names], bool)
    used = np.flatnonzero(near & present).tolist()
    if not used:
        raise SceneNotFoundError(
            f"images of {root / 'rgb.txt'} with a pose in groundtruth.txt within {_TOLERANCE} s",
            found=f"{int(present.sum())} of {len(names)} images, {int(near.sum())} with a pose",
            fix="Put the images back, and check that both files count time alike.",
        )
    # Names omit the folder that all images lie in.
    folders = {PurePosixPath(name).parent for name in names}
    folder = folders.pop() if len(folders) == 1 else PurePosixPath()
    images = []
    for i in used:
        _check_image(root / names[i], intrinsics)
        quat = quats[i] * [1, -1, -1, -1]  # the inverse rotation
        name = str(PurePosixPath(names[i]).relative_to(folder))
        translation = -rotation_from_quat(quat) @ centers[i]
        images.append(Image(name, i + 1, intrinsics, quat, translation))
    lost = [names[i] for i in np.flatnonzero(~near)]
    missing = [names[i] for i in np.flatnonzero(near & ~present)]
    scene = Scene(
        PointCloud.empty(),
        tuple(images),
        (intrinsics,),
        source=SceneSource("rgbd", root, root / "groundtruth.txt", image_dir=root / folder),
        warnings=(
            *guessed,
            *_left_out("image", "a pose close in time", lost),
            *_left_out("image", "a file", missing),
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
    times, names = _read_list(root / "rgb.txt")
    depth_times, depth_names = _read_list(root / "depth.txt")
    nearest = _nearest_in_time(depth_times, times)
    entries = {PurePosixPath(name).name: i for i, name in enumerate(names) if nearest[i] >= 0}
    paths, originals = dict[str, Path](), dict[str, Path]()
    for image in scene.images:
        entry = entries.get(safe_parts(image.name)[-1])
        if entry is not None and (path := root / depth_names[nearest[entry]]).is_file():
            paths[image.name], originals[image.name] = path, root / names[entry]
    if not paths:
        return None
    camera_file = _camera_file(root)
    scale = read_capture_scale(camera_file) if camera_file else None
    lens = _undistortion(scene, _tum_camera(root)[0], originals)
    return DepthFiles(paths, "z", scale or _DEPTH_SCALE, lens)


def _undistortion(
    scene: Scene, lens: Intrinsics, originals: dict[str, Path]
) -> Undistortion | None:
    """Moves maps to the scene's photographs; None if those are the capture's own."""
    posed = {image.name: image.intrinsics for image in scene.images if image.name in originals}
    if lens.is_pinhole or not all(camera.is_pinhole for camera in posed.values()):
        return None
    folder = scene.source.image_dir if scene.source else None
    if folder is not None:
        name, original = next(iter(originals.items()))
        both = (folder / name, original)
        if all(each.is_file() for each in both) and len({each.read_bytes() for each in both}) == 1:
            return None
    return Undistortion(lens, posed)


def _tum_camera(root: Path) -> tuple[Intrinsics, tuple[str, ...]]:
    """The capture's camera, and a warning if it is a guess."""
    path = _camera_file(root)
    if path is not None:
        return _read_intrinsics(path), ()
    series = _SERIES.search(root.name) or _SERIES.search(root.resolve().name)
    fx, fy, cx, cy, *distortion = _COLOR_CAMERAS[series[1]] if series else _DEFAULT_CAMERA
    pinhole = (fx, fy, cx + 0.5, cy + 0.5)
    if distortion:
        params = (*pinhole, *distortion, 0.0, 0.0, 0.0)
        return Intrinsics(1, "FULL_OPENCV", *_SIZE, params), ()
    guess = (
        f"{root} has no cam_params.json and no freiburg1, 2 or 3 in its name: focal length 525"
        " and the middle of the image are assumed."
    )
    return Intrinsics(1, "PINHOLE", *_SIZE, pinhole), () if series else (guess,)


def _camera_file(root: Path) -> Path | None:
    paths = (folder / CAMERA_FILE for folder in (root, root.resolve().parent))
    return next((path for path in paths if path.is_file()), None)


def _read_intrinsics(path: Path) -> Intrinsics:
    """The pinhole camera in a camera file, whose corner is at (0, 0), as in COLMAP."""
    content = read_json(path)
    with guarded(path, 'a file of {"camera": {w, h, fx, fy, cx, cy}}, as numbers in pixels'):
        camera = content["camera"]
        width, height = int(camera["w"]), int(camera["h"])
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        if not (np.isfinite([width, height, fx, fy, cx, cy]).all() and min(width, height) > 0):
            raise ValueError(f"w={width} h={height} cx={cx} cy={cy}")
        if min(fx, fy) <= 0:
            raise ValueError(f"fx={fx} fy={fy}")
        return Intrinsics(1, "PINHOLE", width, height, (fx, fy, cx, cy))


def _check_image(path: Path, intrinsics: Intrinsics) -> None:
    """Check that an image can be read and has the size of its camera; only its header is opened."""
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    expected = (intrinsics.width, intrinsics.height)
    with guarded(path, "a readable image"), open_file(path) as file, PilImage.open(file) as image:
        size = image.size
    if size != expected:
        raise SceneFormatError(
            f"{path} to have the size of the capture's camera, {expected[0]}x{expected[1]}",
            found=f"{size[0]}x{size[1]}",
            fix=f"Write the camera of these images into {CAMERA_FILE}, scaled as they are.",
        )


def _left_out(noun: str, lacking: str, names: Sequence[str]) -> tuple[str, ...]:
    if not names:
        return ()
    are = agreeing(len(names), "is", "are")
    what = f"{counted(len(names), noun)} without {lacking}"
    return (f"{what} {are} left out, the first is {names[0]}.",)


def _list(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _read_trajectory(path: Path) -> Float64[np.ndarray, "N 4 4"]:
    """The poses ``world_from_cam`` of all lines; NaN is kept."""
    rows = [_numbers(where, words) for where, words in _records(path, 16, comments=False)]
    return np.array(rows).reshape(-1, 4, 4)


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


class _Track(NamedTuple):
    """The camera's trajectory: sorted seconds, world positions, unit wxyz of ``world_from_cam``."""

    times: Float64[np.ndarray, " M"]
    centers: Float64[np.ndarray, "M 3"]
    quats: Float64[np.ndarray, "M 4"]


def _read_list(path: Path) -> tuple[Float64[np.ndarray, " N"], tuple[str, ...]]:
    """The times and the relative paths of ``rgb.txt`` or ``depth.txt``, sorted by time."""
    records = []
    for where, words in _records(path, 2):
        name = PurePosixPath(words[1].replace("\\", "/"))
        time = _numbers(where, words[:1])[0]
        if name.is_absolute() or ".." in name.parts or not name.name or not np.isfinite(time):
            raise _bad(where, "a time and a path inside the folder", " ".join(words))
        records.append((time, str(name)))
    records.sort()
    return np.array([time for time, _ in records], np.float64), tuple(name for _, name in records)


def _read_track(path: Path) -> _Track:
    """The poses of ``groundtruth.txt`` that are finite (tracking was not lost), sorted by time."""
    rows = []
    for where, words in _records(path, 8):
        row = _numbers(where, words)
        if not np.isfinite(row).all():
            continue
        if abs(np.linalg.norm(row[4:]) - 1) > _NORM_SLACK:
            raise _bad(where, "a quaternion of length 1", " ".join(words[4:]))
        rows.append(row)
    table = np.array(sorted(rows), np.float64).reshape(-1, 8)
    quats = table[:, [7, 4, 5, 6]]
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return _Track(table[:, 0], table[:, 1:4], quats / norms)


def _nearest_in_time(
    times: Float64[np.ndarray, " M"], wanted: Float64[np.ndarray, " N"]
) -> Int64[np.ndarray, " N"]:
    """Index of the sorted ``times`` nearest to each wanted one; -1 beyond the tolerance."""
    if not len(times):
        return np.full(len(wanted), -1, np.int64)
    before, after = _around(times, wanted)
    earlier = np.abs(times[before] - wanted) <= np.abs(times[after] - wanted)
    nearest = np.where(earlier, before, after)
    return np.where(np.abs(times[nearest] - wanted) <= _TOLERANCE, nearest, -1)


def _poses_at(
    track: _Track, times: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "N 4"], Float64[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
    """Quaternions and centres at given times, and which are known.

    Between two records that are near enough a pose is interpolated, else it is the nearest one's.
    """
    if not len(track.times):
        return np.ones((len(times), 4)), np.zeros((len(times), 3)), np.zeros(len(times), bool)
    nearest = _nearest_in_time(track.times, times)
    before, after = _around(track.times, times)
    span = track.times[after] - track.times[before]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (times - track.times[before]) / span
    between = (share >= 0) & (share <= 1) & (span <= 2 * _TOLERANCE)
    share = np.where(between, share, nearest == after)[:, None]
    start, end = track.quats[before], track.quats[after]
    end = end * np.where((start * end).sum(axis=1) < 0, -1, 1)[:, None]  # the shorter way round
    quats = (1 - share) * start + share * end  # as good as slerp over hundredths of a second
    centers = (1 - share) * track.centers[before] + share * track.centers[after]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True), centers, nearest >= 0


def _around(
    times: Float64[np.ndarray, " M"], wanted: Float64[np.ndarray, " N"]
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " N"]]:
    """The records before and after each wanted time; the same one at the ends."""
    after = np.searchsorted(times, wanted)
    last = len(times) - 1
    return np.clip(after - 1, 0, last), np.clip(after, 0, last)


def _records(path: Path, count: int, *, comments: bool = True) -> Iterator[tuple[str, list[str]]]:
    """The place and the ``count`` words of each line that has any."""
    data = read_bytes(path)
    with guarded(path, "text in UTF-8"):
        text = data.decode("utf-8")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or (comments and words[0].startswith("#")):
            continue
        where = f"{path} line {number}"
        if len(words) != count:
            raise _bad(where, f"{count} words", f"{len(words)}")
        yield where, words


def _numbers(where: str, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise _bad(where, "numbers", str(error)) from None


def _bad(where: str, expected: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {where}", found=found[:200], fix="Correct the line.")
