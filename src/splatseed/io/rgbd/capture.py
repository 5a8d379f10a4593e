"""Shared by the RGB-D layouts: the camera file, and images of its size.

Promise: every failure names the file and is one of ``splatseed.errors``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.depth.folder import CAMERA_FILE
from splatseed.io.files import open_file, read_file
from splatseed.literal import told


def find_camera_file(root: Path) -> Path | None:
    """The camera file of a capture, if there is one."""
    paths = (folder / CAMERA_FILE for folder in (root, root.resolve().parent))
    return next((path for path in paths if path.is_file()), None)


def read_intrinsics(path: Path) -> Intrinsics:
    """The pinhole camera in a camera file, whose corner is at (0, 0), as in COLMAP.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no such file, or its numbers cannot be a camera.
    """
    try:
        camera: Any = json.loads(read_text(path))["camera"]
        width, height = int(camera["w"]), int(camera["h"])
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
    except (KeyError, OverflowError, RecursionError, TypeError, ValueError) as error:
        raise SceneFormatError(
            f'{path} to hold {{"camera": {{w, h, fx, fy, cx, cy}}}} as numbers',
            found=told(error),
            fix="Write the camera's size, focal lengths and principal point in pixels.",
        ) from error
    values = (width, height, fx, fy)
    if not (np.isfinite([*values, cx, cy]).all() and min(values) > 0):
        raise SceneFormatError(
            f"{path} to hold a positive size and focal lengths",
            found=f"w={width} h={height} fx={fx} fy={fy} cx={cx} cy={cy}",
            fix="Write them in pixels.",
        )
    return Intrinsics(1, "PINHOLE", width, height, (fx, fy, cx, cy))


def check_size(path: Path, intrinsics: Intrinsics) -> None:
    """Check that an image can be read and has the size of its camera; only its header is opened.

    Raises:
        SceneFormatError: It cannot be read, or has another size.
    """
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    expected = (intrinsics.width, intrinsics.height)
    try:
        with open_file(path) as file, PilImage.open(file) as image:
            size = image.size
    except (OSError, ValueError, PilImage.DecompressionBombError) as error:
        raise SceneFormatError(
            f"{path} to be a readable image", found=told(error), fix="Export the frame again."
        ) from error
    if size != expected:
        raise SceneFormatError(
            f"{path} to have the size of the capture's camera, {expected[0]}x{expected[1]}",
            found=f"{size[0]}x{size[1]}",
            fix=f"Write the camera of these images into {CAMERA_FILE}, scaled as they are.",
        )


def read_text(path: Path) -> str:
    """The text of one of a capture's files.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read, or is not UTF-8.
    """
    try:
        return read_file(path).decode("utf-8")
    except FileNotFoundError as error:
        raise SceneNotFoundError(
            f"a file {path}", found="none", fix="Give the folder of an RGB-D capture."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise SceneFormatError(
            f"{path} to be a readable text file", found=told(error), fix="Check the file."
        ) from error
