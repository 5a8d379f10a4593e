"""Raw exports of Polycam: photographs, poses and LiDAR depth of its key frames.

``keyframes`` has folders whose files are named by a key frame's time: ``images`` and ``cameras``
as ARKit has them; ``corrected_images`` (undistorted, black along the borders) and
``corrected_cameras`` (globally optimised) if the app could optimise; ``depth`` (planar z, 16-bit
millimetres) and ``confidence`` (0, 127, 255 for low, medium, high). A camera has ``fx``, ``fy``,
``cx``, ``cy``, ``width``, ``height`` and ``t_00`` to ``t_23``, the rows of ``world_from_cam`` in
OpenGL axes. Since 2025, corrected cameras lack width and height: they have the photographs' size.
Source: the README of Polycam's repository polyform; nerfstudio's pull request 3725. They do not say
where pixels are counted from: the image corner is assumed, which may be half a pixel off.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.depth_maps import match_by_name
from splatseed.io.files import StrPath, image_names, is_hidden
from splatseed.io.phone import (
    EXPORT_AGAIN,
    PhoneFrame,
    read_numbers,
    read_phone_scene,
    read_record,
    without_photograph,
)
from splatseed.io.photograph_checks import photograph_size
from splatseed.scene import Scene
from splatseed.text import agreeing, counted, quoted

KEYFRAMES = "keyframes"
_CORRECTED = "corrected_"
_ROWS = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
_PINHOLE = ("fx", "fy", "cx", "cy")
_SIZE = ("width", "height")
_FOCAL = (0.2, 5.0)  # plausible focal lengths, in longer sides


def is_polycam(folder: Path) -> bool:
    """Whether a folder is a raw export of Polycam or its key frames, with or without cameras."""
    return _keyframes(folder) is not None


def _keyframes(folder: Path) -> Path | None:
    """Find the folder of key frames: in an export, or the folder itself."""
    inside = folder / KEYFRAMES
    if any((inside / name).is_dir() for name in ("images", "corrected_images", "cameras")):
        return inside
    cameras = [folder / f"{prefix}cameras" for prefix in ("", _CORRECTED)]
    itself = folder.resolve().name == KEYFRAMES and (folder / "images").is_dir()
    if cameras[1].is_dir() or (itself and not any(folder.glob("*.json"))):
        return folder
    return None


def read_polycam(root: StrPath) -> Scene:
    """Read key frames, corrected ones if there are any, with depth maps; the cloud is empty."""
    root = Path(root)
    keyframes = _keyframes(root) or root
    prefix, names, cameras = _choose(keyframes)
    used = [name for name in names if Path(name).stem in cameras]
    folder = keyframes / f"{prefix}images"
    if not used:
        what = f"{prefix}cameras and {prefix}images" if prefix else "cameras and images"
        raise SceneNotFoundError(
            f"photographs and their cameras in {keyframes} ({what})",
            found=f"{counted(len(names), 'photograph')} and {counted(len(cameras), 'camera')}"
            + (" of other names" if names and cameras else ""),
            fix="In Polycam, switch Developer mode on, process the scan again and export raw data"
            + (f"; or run: splatseed sfm {quoted(folder)} -o SCENE." if names else "."),
        )
    findings = []
    if lost := [name for name in names if name not in used]:
        have = agreeing(len(lost), "has no camera and is", "have no camera and are")
        text = f"{len(lost)} of {len(names)} photographs {have} left out, such as {lost[0]}."
        findings.append(Finding("missing-poses", text, subjects=tuple(lost)))
    findings += without_photograph(len(cameras) - len(used), len(cameras), "camera")

    def read(name: str) -> PhoneFrame:
        return _read_camera(cameras[Path(name).stem], folder / name)

    track = cameras[Path(used[0]).stem]
    scene = read_phone_scene(root, track, folder, used, read, findings)
    return scene.replace(depths=match_by_name(scene, keyframes))


def _choose(keyframes: Path) -> tuple[str, list[str], dict[str, Path]]:
    """Choose corrected key frames if both their folders have files, else the original ones.

    Returns the prefix of the folders, the sorted names of photographs, and cameras by key frame.
    """
    for prefix in (_CORRECTED, ""):
        images, cameras = keyframes / f"{prefix}images", keyframes / f"{prefix}cameras"
        names = image_names(images)
        found = (path for path in sorted(cameras.glob("*.json")) if not is_hidden(path.name))
        records = {path.stem: path for path in found}
        if names and records:
            break
    return prefix, names, records


def _read_camera(path: Path, photograph: Path) -> PhoneFrame:
    record = read_record(path, "a camera of Polycam")
    pose = np.array(read_numbers(f"{path}", record, _ROWS)).reshape(3, 4)
    fx, fy, cx, cy = read_numbers(f"{path}", record, _PINHOLE)
    if all(record.get(side) is None for side in _SIZE):
        # Photographs that were resized since do not have the principal point in the middle.
        sizes = [photograph_size(photograph)]
        original = path.parent.with_name("cameras") / path.name
        found = read_record(original, "a camera of Polycam") if original.is_file() else {}
        if found.keys() >= {*_SIZE}:
            sizes.append(_size(original, found))
        size = min(sizes, key=lambda each: max(abs(cx / each[0] - 0.5), abs(cy / each[1] - 0.5)))
        if not _FOCAL[0] <= min(fx, fy) / max(size) <= max(fx, fy) / max(size) <= _FOCAL[1]:
            raise SceneFormatError(
                f"focal lengths of a phone in {path}, for {size[0]} x {size[1]} pixels",
                found=f"fx {fx:g}, fy {fy:g}",
                fix=EXPORT_AGAIN,
            )
    else:
        size = _size(path, record)
    return PhoneFrame(f"{path}", size, (fx, fy, cx, cy), pose)


def _size(path: Path, record: Mapping[str, Any]) -> tuple[int, int]:
    width, height = read_numbers(f"{path}", record, _SIZE)
    if not (width.is_integer() and height.is_integer() and min(width, height) > 0):
        raise SceneFormatError(
            f"width and height in pixels in {path}",
            found=f"{width:g} x {height:g}",
            fix=EXPORT_AGAIN,
        )
    return int(width), int(height)
