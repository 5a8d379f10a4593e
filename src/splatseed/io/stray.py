"""Recordings of Stray Scanner: a video, a pose per frame, and LiDAR depth.

``rgb.mp4``; ``odometry.csv`` with a line per frame (``timestamp, frame, x, y, z, qx, qy, qz, qw``,
and ``fx, fy, cx, cy`` in newer versions), ``world_from_cam`` in metres and, unlike ARKit's, OpenCV
axes; ``camera_matrix.csv``, K of the last frame, row by row; ``depth/NNNNNN.png`` (.npy in older
versions), planar z in millimetres, and ``confidence/NNNNNN.png`` with ARKit's levels 0 to 2. A
line's ``frame`` names its maps; its place among the lines is that of its frame in the video. Chosen
frames are extracted once, into the user's cache.

The app times the first frame before the video's time 0, so players hide it. Unless ffmpeg ignores
the edit list, each frame gets the pose of the one before. Sources: github.com/strayrobots/scanner
(docs/format.md, ``OdometryEncoder``, ``VideoEncoder``), github.com/kekeblom/StrayVisualizer.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.camera import rotation_from_quat
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.camera_records import OPENCV_FROM_OPENGL, check_pose, check_unit_quat
from splatseed.io.depth_maps import DepthFiles, find_confidences
from splatseed.io.files import COPY_AGAIN, StrPath, numbered_lines, read_json
from splatseed.io.phone import HALF_PIXEL, PhoneFrame, read_phone_scene
from splatseed.io.photograph_checks import photograph_size
from splatseed.io.recordings import (
    FILM,
    choose_frames,
    chosen_finding,
    extracted,
    identity,
    pose_motion,
    sharpness,
    small_frames,
    write_frames,
)
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.text import counted

VIDEO, ODOMETRY, CAMERA = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_PINHOLE = ("fx", "fy", "cx", "cy")
_DEPTH_SCALE = 1000.0
"""Stored units per metre."""
_COUNT = "frames.json"
_FIX = "Export the recording from the app again."


def is_stray(folder: Path) -> bool:
    """Whether a folder is a recording of Stray Scanner, perhaps without one of its files."""
    return sum((folder / name).is_file() for name in (VIDEO, ODOMETRY, CAMERA)) > 1


def read_stray(root: StrPath) -> Scene:
    """Read the sharpest frames, evenly spaced by motion, with their depth maps; without points."""
    root = Path(root)
    for name, holds in ((ODOMETRY, "the poses"), (VIDEO, "the photographs")):
        if not (root / name).is_file():
            expected = f"{root / name}, with {holds} of Stray Scanner"
            raise SceneNotFoundError(expected, found="no such file", fix=_FIX)
    track = _read_track(root)
    folder = _extract(root / VIDEO, track)
    total = int(read_json(folder / _COUNT)["total"])
    names = sorted(path.name for path in folder.glob("*.jpg"))
    size = photograph_size(folder / names[0])
    findings = _findings(track, len(names), total)

    def frame(name: str) -> PhoneFrame:
        return track.frame(int(Path(name).stem), size)

    scene = read_phone_scene(root, root / ODOMETRY, folder, names, frame, findings)
    maps = {im.name: track.depth(root, int(Path(im.name).stem)) for im in scene.images}
    paths = {name: path for name, path in maps.items() if path is not None}
    confidences = find_confidences(paths)
    depths = DepthFiles(paths, "z", _DEPTH_SCALE, confidences=confidences) if paths else None
    return scene.replace(depths=depths)


@dataclass(frozen=True, eq=False)
class _Track:
    """The lines of ``odometry.csv``, checked but for single frames."""

    path: Path
    lines: Sequence[str]  # "PATH, line N"
    numbers: Sequence[int]  # of the depth maps
    poses: Float64[np.ndarray, "N 7"]  # x y z qx qy qz qw
    pinholes: Float64[np.ndarray, "N 4"]  # fx fy cx cy, from the first pixel's centre

    @property
    def usable(self) -> Bool[np.ndarray, " N"]:
        """Which poses are finite, and not zero."""
        return np.asarray(np.isfinite(self.poses).all(axis=1) & self.poses[:, 3:].any(axis=1))

    def frame(self, index: int, size: tuple[int, int]) -> PhoneFrame:
        """Return the camera and pose of a frame of the video."""
        where, pose = self.lines[index], self.poses[index]
        quat, center = pose[[6, 3, 4, 5]], pose[:3]
        check_pose((*quat, *center), "of a frame", where)
        check_unit_quat(quat, where, _FIX)
        rotation = rotation_from_quat(quat) @ OPENCV_FROM_OPENGL[:3, :3]  # its own inverse
        fx, fy, cx, cy = self.pinholes[index].tolist()
        pinhole = (fx, fy, cx + HALF_PIXEL, cy + HALF_PIXEL)
        return PhoneFrame(where, size, pinhole, np.column_stack([rotation, center]))

    def depth(self, root: Path, index: int) -> Path | None:
        """Find the depth map of a frame of the video."""
        stem = root / "depth" / f"{self.numbers[index]:06}"
        return next((p for s in (".png", ".npy") if (p := stem.with_suffix(s)).is_file()), None)


def _read_track(root: Path) -> _Track:
    path = root / ODOMETRY
    records = [(where, line) for where, line in numbered_lines(path) if line.strip()]
    header = [name.strip() for name in records[0][1].split(",")] if records else []
    columns = {name: column for column, name in enumerate(header)}
    if missing := [name for name in ("frame", *_POSE) if name not in columns]:
        expected = f"a first line with timestamp, frame, {', '.join(_POSE)} in {path}"
        found = f"no {', '.join(missing)}" if header else "an empty file"
        raise SceneFormatError(expected, found=found, fix=_FIX)
    if len(records) < 2:
        raise SceneFormatError(f"poses in {path}", found="only a first line", fix=_FIX)
    lens = [*_PINHOLE] if all(name in columns for name in _PINHOLE) else []
    wanted = [columns[name] for name in ("frame", *_POSE, *lens)]
    rows = []
    for where, line in records[1:]:
        fields = line.split(",")
        try:
            rows.append([float(fields[column]) for column in wanted])
        except (ValueError, IndexError):
            expected = f"{len(header)} numbers, separated by commas, in {where}"
            raise SceneFormatError(expected, found=line.strip()[:120], fix=COPY_AGAIN) from None
    if not lens and not (root / CAMERA).is_file():
        expected = f"columns {', '.join(_PINHOLE)} in {path}, or a file {root / CAMERA}"
        raise SceneNotFoundError(expected, found="neither", fix=_FIX)
    table = np.array(rows, np.float64)
    numbers = table[:, 0]
    if not (np.isfinite(numbers).all() and (np.diff(numbers) > 0).all() and numbers[0] >= 0):
        raise SceneFormatError(f"rising frame numbers in {path}", found="others", fix=COPY_AGAIN)
    pinholes = table[:, 8:] if lens else np.tile(_read_camera(root / CAMERA), (len(table), 1))
    places = [where for where, _ in records[1:]]
    return _Track(path, places, numbers.astype(int).tolist(), table[:, 1:8], pinholes)


def _read_camera(path: Path) -> Float64[np.ndarray, " 4"]:
    """Read fx, fy, cx, cy from K; the app writes it when a recording ends."""
    text = [(where, line) for where, line in numbered_lines(path) if line.strip()]
    try:
        K = np.array([[float(each) for each in line.split(",")] for _, line in text])
        fx, skew, cx, zero, fy, cy, *last = K.ravel().tolist()
    except ValueError:
        K, skew, zero, last = np.zeros(0), 1.0, 1.0, []
    if K.shape != (3, 3) or [skew, zero, *last] != [0, 0, 0, 0, 1]:
        found = " ".join(line.strip() for _, line in text)[:120] or "an empty file"
        raise SceneFormatError(f"{path} to be fx 0 cx 0 fy cy 0 0 1", found=found, fix=_FIX)
    return np.array([fx, fy, cx, cy])


def _extract(video: Path, track: _Track) -> Path:
    """Return the folder of chosen frames, named by their lines, and the number of all frames."""

    def fill(folder: Path, progress: Progress) -> None:
        sharp = np.array([sharpness(each) for each in small_frames(video, progress, hidden=True)])
        first = _first_line(video, track, len(sharp))
        usable = np.flatnonzero(track.usable)
        usable = usable[(usable >= first) & (usable < first + len(sharp))]
        rotations = np.array([rotation_from_quat(q) for q in track.poses[usable][:, [6, 3, 4, 5]]])
        # The principal point is near the middle; the width is not known yet.
        focal = float(np.nanmedian(track.pinholes[:, 0] / (2 * track.pinholes[:, 2])))
        motion = pose_motion(rotations.reshape(-1, 3, 3), track.poses[usable, :3], focal)
        chosen = usable[choose_frames(sharp[usable - first], motion, FILM.max_frames)] - first
        path_of = {number: folder / f"{number + first:06}.jpg" for number in chosen.tolist()}
        write_frames(video, path_of, progress, hidden=True)
        (folder / _COUNT).write_text(json.dumps({"total": len(sharp)}), "utf-8")

    facts = (identity(video), track.poses.tobytes(), track.pinholes.tobytes(), FILM)
    return extracted(video.absolute().parent, facts, fill)


def _first_line(video: Path, track: _Track, total: int) -> int:
    num_poses = len(track.poses)
    if total >= num_poses:
        return 0
    if total == num_poses - 1:
        return 1
    raise SceneFormatError(
        f"{video} to have the {counted(num_poses, 'frame')} of {ODOMETRY}",
        found=f"{total:,}",
        fix="Use the video as the app wrote it: not cut, and not at another frame rate.",
    )


def _findings(track: _Track, used: int, total: int) -> list[Finding]:
    findings = []
    if used < min(total, len(track.poses)):
        findings.append(chosen_finding(f"{used:,} of the {total:,} frames of {VIDEO}"))
    if total != len(track.poses):
        frames, lines = counted(total, "frame"), counted(len(track.poses), "pose")
        first = "the first pose has none" if total < len(track.poses) else "the last have no pose"
        text = f"{VIDEO} has {frames} and {ODOMETRY} {lines}: {first}."
        findings.append(Finding("missing-poses", text))
    return findings
