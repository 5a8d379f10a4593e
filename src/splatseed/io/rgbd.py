"""RGB-D captures: Replica in NICE-SLAM's layout, and TUM's RGB-D benchmark (also 7-Scenes).

Replica: ``results/frame*.jpg`` (or .png), ``results/depth*.png``, ``traj.txt`` with a row-major
4 x 4 ``world_from_cam`` per line in the order of frame numbers, and ``cam_params.json`` in the
folder or its parent. The principal point is measured from the image corner: Replica's renderer uses
(w - 1) / 2 in OpenGL, and its depth maps are consistent with that. TUM: ``rgb.txt`` and
``depth.txt`` (``time path``, seconds), ``groundtruth.txt`` (``time tx ty tz qx qy qz qw`` of
``world_from_cam``); depth PNGs hold planar z times 5000. Both: OpenCV axes, metres.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatseed.camera import Intrinsics, rotation_from_quat
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io import depth_maps
from splatseed.io.camera_records import check_unit_quat, left_out, make_intrinsics, rigid_pose
from splatseed.io.files import StrPath, is_data, numbered_lines, read_json, translate_errors
from splatseed.io.origin import recentered
from splatseed.io.photograph import lens_findings
from splatseed.io.photograph_checks import photograph_size
from splatseed.pointcloud import PointCloud
from splatseed.scene import OPENCV, Image, Scene, SceneSource

_FRAME = re.compile(r"frame(\d+)\.(?:jpe?g|png)", re.IGNORECASE)
_TOLERANCE = 0.02
"""Largest difference in time between an image and its depth map or pose, seconds."""
_DEPTH_SCALE = 5000.0
"""TUM's stored units per metre."""
_WXYZ = [7, 4, 5, 6]
"""Columns of a quaternion in ``groundtruth.txt``."""
_FIX = "Correct the line."
_SIZE = (640, 480)
_SERIES = re.compile(r"(?:freiburg|(?<![a-z])fr)_?([123])(?!\d)", re.IGNORECASE)
_COLOR_CAMERAS: dict[str, tuple[float, ...]] = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""fx fy cx cy k1 k2 p1 p2 k3 of the colour cameras, from the benchmark's page "File formats" (the
images of freiburg3 are undistorted). The first pixel's centre is (0, 0) there."""
_DEFAULT_CAMERA = (525.0, 525.0, 319.5, 239.5)  # the ROS default, on the same page


def is_replica(root: Path) -> bool:
    """Whether a folder has the trajectory file of Replica's layout."""
    return (root / "traj.txt").is_file()


def load_rgbd(root: StrPath) -> Scene:
    """Read Replica's layout; frames without a finite pose are left out."""
    root = Path(root)
    folder, track = root / "results", root / "traj.txt"
    listed = folder.iterdir() if folder.is_dir() else ()
    numbered = [(int(m[1]), p.name, p) for p in listed if (m := _FRAME.fullmatch(p.name))]
    frames = [path for *_, path in sorted(numbered)]
    if not frames:
        raise SceneNotFoundError(
            f"images {folder / 'frame000000.jpg'}, ...",
            found="none" if folder.is_dir() else f"no folder {folder}",
            fix="Pass the folder that contains traj.txt and results/.",
        )
    rows = [_numbers(where, fields) for where, fields in _records(track, 16)]
    poses = np.array(rows).reshape(-1, 4, 4)
    if len(frames) != len(poses):
        raise SceneFormatError(
            f"{track} to have one line per frame, {len(frames)} for {folder}",
            found=f"{len(poses)} lines",
            fix="Restore the missing frames or lines.",
        )
    camera = depth_maps.camera_file(root)
    if camera is None:
        raise SceneNotFoundError(
            f"{depth_maps.CAMERA_FILE} in {root} or the folder above it",
            found="neither",
            fix='Write {"camera": {"w": 9, "h": 9, "fx": 9, "fy": 9, "cx": 9, "cy": 9}}.',
        )
    intrinsics = read_camera_file(camera)
    tracked = np.isfinite(poses).all(axis=(1, 2))
    images = []
    for i in np.flatnonzero(tracked).tolist():
        quat, translation = rigid_pose(f"{track}, pose {i + 1}", poses[i])
        _check_image(frames[i], intrinsics)
        images.append(Image(frames[i].name, i + 1, intrinsics, quat, translation))
    lost = [frames[i].name for i in np.flatnonzero(~tracked)]
    findings = left_out("missing-poses", "frame", "a finite pose", lost)
    scene = _scene(track, folder, images, intrinsics, *findings)
    return scene.replace(depths=depth_maps.match_by_name(scene, folder))


def _scene(
    track: Path, folder: Path, images: Sequence[Image], lens: Intrinsics, *findings: Finding
) -> Scene:
    convention = f"its trajectory holds world_from_cam, {OPENCV}"
    source = SceneSource("rgbd", track.parent, track, image_dir=folder, convention=convention)
    points = PointCloud.empty()
    return recentered(Scene(points, tuple(images), (lens,), source=source, findings=findings))


def is_tum(root: Path) -> bool:
    """Whether a folder has the list files of TUM's layout."""
    return (root / "rgb.txt").is_file() and (root / "groundtruth.txt").is_file()


def load_tum(root: StrPath) -> Scene:
    """Read TUM's layout.

    Poses are interpolated between the records before and after an image if both are close in time,
    else taken from the nearest. Images without a pose or a file are left out, with a finding.
    """
    root = Path(root)
    track = root / "groundtruth.txt"
    times, names = _read_list(root / "rgb.txt")
    intrinsics, guessed = _tum_camera(root)
    quats, centers, near = _poses_at(_read_track(track), times)
    present = np.array([(root / name).is_file() for name in names], bool)
    used = np.flatnonzero(near & present).tolist()
    if not used:
        raise SceneNotFoundError(
            f"images of {root / 'rgb.txt'} with a pose in groundtruth.txt within {_TOLERANCE} s",
            found=f"{int(present.sum())} of {len(names)} images, {int(near.sum())} with a pose",
            fix="Restore the images, and check that both files use the same clock.",
        )
    # Names omit a folder that all images share.
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
    findings = [*guessed, *left_out("missing-poses", "image", "a pose close in time", lost)]
    findings += left_out("missing-photographs", "image", "a file", missing)
    findings += lens_findings(images)
    scene = _scene(track, root / folder, images, intrinsics, *findings)
    return scene.replace(depths=find_tum_depths(scene, root))


def find_tum_depths(scene: Scene, root: Path) -> depth_maps.DepthFiles | None:
    """Find the depth maps nearest in time to the images of a scene made from a capture.

    Images are matched by file name. If the capture's lens has distortion and the scene's
    photographs are undistorted copies (by ``splatseed sfm`` or COLMAP), the maps are undistorted
    on reading. None if no image has a map.
    """
    if not (root / "depth.txt").is_file():
        return None
    times, names = _read_list(root / "rgb.txt")
    depth_times, depth_names = _read_list(root / "depth.txt")
    _, nearest = _locate(depth_times, times)
    entries = {PurePosixPath(name).name: i for i, name in enumerate(names) if nearest[i] >= 0}
    paths, originals = dict[str, Path](), dict[str, Path]()
    for image in scene.images:
        entry = entries.get(depth_maps.safe_parts(image.name)[-1])
        if entry is not None and (path := root / depth_names[nearest[entry]]).is_file():
            paths[image.name], originals[image.name] = path, root / names[entry]
    if not paths:
        return None
    camera = depth_maps.camera_file(root)
    scale = depth_maps.read_capture_scale(camera) if camera else None
    posed = {image.name: image.intrinsics for image in scene.images if image.name in paths}
    lens = _tum_camera(root)[0]
    undistorted = lens.has_distortion and not any(each.has_distortion for each in posed.values())
    if undistorted and scene.source.image_dir is not None:
        name, original = next(iter(originals.items()))
        both = (scene[name].path, original)
        undistorted = not all(p.is_file() for p in both) or len({p.read_bytes() for p in both}) > 1
    moved = depth_maps.Undistortion(dict.fromkeys(posed, lens), posed) if undistorted else None
    return depth_maps.DepthFiles(paths, "z", scale or _DEPTH_SCALE, moved)


def _tum_camera(root: Path) -> tuple[Intrinsics, tuple[Finding, ...]]:
    """Return the capture's camera, and a finding if it is a guess.

    From ``cam_params.json``, else published values for the series in the folder's name, else the
    ROS default.
    """
    if (path := depth_maps.camera_file(root)) is not None:
        return read_camera_file(path), ()
    series = _SERIES.search(root.name) or _SERIES.search(root.resolve().name)
    fx, fy, cx, cy, *distortion = _COLOR_CAMERAS[series[1]] if series else _DEFAULT_CAMERA
    pinhole = (fx, fy, cx + 0.5, cy + 0.5)
    if distortion:
        params = (*pinhole, *distortion, 0.0, 0.0, 0.0)
        return Intrinsics(1, "FULL_OPENCV", *_SIZE, params), ()
    guess = (
        f"{root} has no cam_params.json and no freiburg1, 2 or 3 in its name: focal length 525"
        " and a central principal point are assumed."
    )
    found = () if series else (Finding("assumed-intrinsics", guess),)
    return Intrinsics(1, "PINHOLE", *_SIZE, pinhole), found


def read_camera_file(path: Path) -> Intrinsics:
    """Read the pinhole camera of a camera file; the image corner is at (0, 0), as in COLMAP."""
    content = read_json(path)
    with translate_errors(
        path, 'a file of {"camera": {w, h, fx, fy, cx, cy}}, as numbers in pixels'
    ):
        camera = content["camera"]
        params = tuple(float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        return make_intrinsics(f"{path}", 1, "PINHOLE", int(camera["w"]), int(camera["h"]), params)


def _check_image(path: Path, intrinsics: Intrinsics) -> None:
    expected = (intrinsics.width, intrinsics.height)
    size = photograph_size(path)
    if size != expected:
        raise SceneFormatError(
            f"{path} to have the size of the capture's camera, {expected[0]}x{expected[1]}",
            found=f"{size[0]}x{size[1]}",
            fix=f"Write the camera of these images into {depth_maps.CAMERA_FILE}.",
        )


def _read_list(path: Path) -> tuple[Float64[np.ndarray, " N"], tuple[str, ...]]:
    records = []
    for where, fields in _records(path, 2):
        name = PurePosixPath(fields[1].replace("\\", "/"))
        time = _numbers(where, fields[:1])[0]
        if name.is_absolute() or ".." in name.parts or not name.name or not np.isfinite(time):
            raise _bad(where, "a time and a path inside the folder", " ".join(fields))
        records.append((time, str(name)))
    records.sort()
    return np.array([time for time, _ in records], np.float64), tuple(name for _, name in records)


def _read_track(path: Path) -> Float64[np.ndarray, "M 8"]:
    """Read ``groundtruth.txt``: seconds, positions and unit wxyz of ``world_from_cam``, by time.

    Records that are not finite (lost tracking) are skipped.
    """
    rows = []
    for where, fields in _records(path, 8):
        row = _numbers(where, fields)
        if not np.isfinite(row).all():
            continue
        check_unit_quat(np.array(row)[_WXYZ], where, _FIX)
        rows.append(row)
    table = np.array(sorted(rows), np.float64).reshape(-1, 8)[:, [0, 1, 2, 3, *_WXYZ]]
    table[:, 4:] /= np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    return table


def _locate(
    times: Float64[np.ndarray, " M"], wanted: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, " N"], Int64[np.ndarray, " N"]]:
    """Locate times among sorted ones: fractional index, and index of the nearest.

    The latter is -1 if further away than the tolerance.
    """
    if not len(times):
        return np.zeros(len(wanted)), np.full(len(wanted), -1)
    index = np.interp(wanted, times, np.arange(len(times)))
    nearest = np.ceil(index - 0.5).astype(np.int64)
    return index, np.where(np.abs(times[nearest] - wanted) <= _TOLERANCE, nearest, -1)


def _poses_at(
    track: Float64[np.ndarray, "M 8"], times: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "N 4"], Float64[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
    """Interpolate quaternions and centres at given times, and return which are known."""
    index, nearest = _locate(track[:, 0], times)
    if not len(track):
        return np.ones((len(times), 4)), np.zeros((len(times), 3)), nearest >= 0
    start, end = track[np.floor(index).astype(int)], track[np.ceil(index).astype(int)]
    share = np.where(end[:, 0] - start[:, 0] <= 2 * _TOLERANCE, index % 1, np.rint(index % 1))
    flip = np.where((start[:, 4:] * end[:, 4:]).sum(axis=1) < 0, -1, 1)  # the shorter rotation
    end[:, 4:] *= flip[:, None]
    mixed = (1 - share[:, None]) * start + share[:, None] * end  # as exact as slerp here
    quats = mixed[:, 4:] / np.linalg.norm(mixed[:, 4:], axis=1, keepdims=True)
    return quats, mixed[:, 1:4], nearest >= 0


def _records(path: Path, count: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the ``count`` fields of each line that is neither empty nor a comment."""
    for where, line in numbered_lines(path):
        if not is_data(line):
            continue
        fields = line.split()
        if len(fields) != count:
            raise _bad(where, f"{count} fields", f"{len(fields)}")
        yield where, fields


def _numbers(where: str, fields: list[str]) -> list[float]:
    try:
        return [float(field) for field in fields]
    except ValueError as error:
        raise _bad(where, "numbers", str(error)) from None


def _bad(where: str, expected: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {where}", found=found[:200], fix=_FIX)
