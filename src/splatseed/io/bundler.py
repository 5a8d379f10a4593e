"""Bundler's ``bundle.out`` (Photo Tourism, VisualSFM, OpenSfM), with its list of photographs.

After a comment: the numbers of cameras and points; five lines per camera, ``f k1 k2``, the rows of
the rotation and the translation of ``cam_from_world`` in OpenGL axes; three per point, position,
colour and the list of views. With P in camera axes and p = -P / P.z, the pixel is f p (1 + k1 |p|^2
+ k2 |p|^4), from the image centre, y up. f is 0 for a camera without a pose. The list has a
photograph per line, in the cameras' order, perhaps followed by other numbers. Source: Bundler's
user manual, "Output format and scene representation".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneNotFoundError
from splatseed.io.camera_records import OPENCV_FROM_OPENGL, Lens, format_error
from splatseed.io.files import IMAGE_SUFFIXES, is_data, numbered_lines
from splatseed.io.photogrammetry import Export, Shot, begins_with, points_of, read_export
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENGL, Scene
from splatseed.text import counted

_CONVENTION = f"each camera has the rotation and translation of cam_from_world, {OPENGL}"
_HEAD = b"# Bundle file"
_CAMERA_LINES, _POINT_LINES = 5, 3


def find_bundler(folder: Path) -> list[Path]:
    """List bundle files in a folder, or in its subfolder ``bundle``."""
    here = begins_with(folder, "*.out", _HEAD)
    return here or begins_with(folder / "bundle", "*.out", _HEAD)


def read_bundler(path: Path, root: Path) -> Scene:
    """Read the cameras that have a pose, and the points."""
    return read_export(_read, path, root, "Bundler's cameras and points")


def _read(path: Path) -> Export:
    lines = [(where, line.split()) for where, line in numbered_lines(path) if is_data(line)]
    if not lines or len(lines[0][1]) != 2:
        raise format_error("the numbers of cameras and points", f"{path}", "none")
    num_cameras, num_points = map(int, lines[0][1])
    first = 1 + num_cameras * _CAMERA_LINES
    if min(num_cameras, num_points) < 0 or len(lines) != first + num_points * _POINT_LINES:
        expected = f"the lines of {num_cameras} cameras and {num_points} points"
        raise format_error(expected, f"{path}", f"{len(lines)} lines")
    names = _photographs(path, num_cameras)
    shots, unposed = list[Shot](), list[str]()
    for i, name in enumerate(names):
        where = lines[1 + i * _CAMERA_LINES][0]
        record = lines[1 + i * _CAMERA_LINES : 1 + (i + 1) * _CAMERA_LINES]
        numbers = np.array([[float(each) for each in fields] for _, fields in record])
        f, k1, k2 = numbers[0].tolist()
        if f == 0:
            unposed.append(name)
            continue
        # Bundler's camera axes are OpenGL's.
        cam_from_world = OPENCV_FROM_OPENGL[:3, :3] @ np.column_stack([numbers[1:4], numbers[4]])
        shots.append(Shot(where, name, None, partial(_lens, f, k1, k2), _inverse(cam_from_world)))
    points = [[float(each) for each in fields] for _, fields in lines[first::_POINT_LINES]]
    colors = [[float(each) for each in fields] for _, fields in lines[first + 1 :: _POINT_LINES]]
    cloud = points_of(points, colors)
    return Export("bundler", path, shots, _CONVENTION, unposed, points=cloud)


def _inverse(cam_from_world: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, "3 4"]:
    rotation = cam_from_world[:, :3].T
    return np.column_stack([rotation, -rotation @ cam_from_world[:, 3]])


def _lens(f: float, k1: float, k2: float, size: Size) -> Lens:
    center = size[0] / 2, size[1] / 2
    return ("RADIAL", (f, *center, k1, k2)) if k1 or k2 else ("SIMPLE_PINHOLE", (f, *center))


def _photographs(path: Path, count: int) -> list[str]:
    """Return the names in the list: of the text files near, the one of as many photographs."""
    near = [path.with_name(f"{path.name}.list.txt"), path.with_name(f"list_{path.stem}.txt")]
    folders = (path.parent, path.parent.parent)
    near += [file for folder in folders for file in sorted(folder.glob("*.txt"))]
    for file in dict.fromkeys(near):
        if file.is_file():
            names = [
                _photograph(line) for _, line in numbered_lines(file, "replace") if is_data(line)
            ]
            if len(names) == count and all(names):
                return names
    raise SceneNotFoundError(
        f"a list of {counted(count, 'photograph')}, one per line, as a .txt file beside {path}",
        found="none",
        fix="Copy Bundler's list.txt there.",
    )


def _photograph(line: str) -> str:
    """Return the name of a photograph in a line of a list, which may have spaces; else ""."""
    fields = line.split()
    for end in range(len(fields), 0, -1):
        if PurePosixPath(fields[end - 1]).suffix.lower() in IMAGE_SUFFIXES:
            return " ".join(fields[:end])
    return ""
