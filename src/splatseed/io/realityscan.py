"""RealityScan (RealityCapture): the registration export "Internal/External camera parameters".

A CSV with a header line such as ``#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``, in
any order, perhaps after a line ``#cameras N``. x, y and alt are the camera's position; with angles
in degrees, ``world_from_cam`` is Rz(-heading) Rx(pitch) Ry(roll) in OpenGL axes. With s the longer
side of the photograph, the focal length is f s / 36 pixels (f in mm of 35 mm film), and the
principal point lies (px s, py s) from the centre. Distortion is Brown's: k1 to k4 of r^2 to r^8,
t1 and t2 as OpenCV's p1 and p2. Columns other than name, position, angles and f may be absent.
Sources: Epic's "RealityCapture XMP Camera Math"; the readers of nerfstudio and Brush.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.io.camera_records import OPENCV_FROM_OPENGL, Lens, brown, format_error
from splatseed.io.files import numbered_lines, open_file
from splatseed.io.photogrammetry import Export, Shot, read_export, with_r8
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENGL, Scene

_CONVENTION = f"positions, and angles whose product is world_from_cam, {OPENGL}"
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_NUMBERS = frozenset(_NEEDED[1:]) | {"px", "py", "k1", "k2", "k3", "k4", "t1", "t2"}
_FILM = 36.0
"""Width of 35 mm film, mm."""


def find_realityscan(folder: Path) -> list[Path]:
    """List exports with positions, angles and focal lengths in a folder."""
    found = []
    for path in sorted(folder.glob("*.csv")):
        if path.is_file():
            with open_file(path) as file:
                start = file.read(4096).decode("utf-8-sig", "replace").splitlines()
            found += [path] if any(_columns(line) for line in start[:2]) else []
    return found


def _columns(line: str) -> list[str]:
    """Return the names of a header's columns; [] for another line."""
    names = [name.strip().lstrip("#").lower() for name in line.split(",")]
    return names if set(names) >= {*_NEEDED} else []


def read_realityscan(path: Path, root: Path) -> Scene:
    """Read the cameras, and the points of a PLY file beside them."""
    return read_export(_read, path, root, "RealityScan's camera parameters")


def _read(path: Path) -> Export:
    names, shots = list[str](), list[Shot]()
    for where, line in numbered_lines(path):
        if not names:
            names = _columns(line)
            continue
        if not line.strip() or line.startswith("#"):
            continue
        (fields,) = csv.reader([line])
        if len(fields) != len(names):
            raise format_error(f"{len(names)} values", where, f"{len(fields)}")
        record = dict(zip(names, fields, strict=True))
        numbers = {
            key: _number(where, key, text) for key, text in record.items() if key in _NUMBERS
        }
        name = record["name"].strip()
        shots.append(Shot(where, name, None, partial(_lens, numbers), _pose(numbers)))
    return Export("realityscan", path, shots, _CONVENTION)


def _number(where: str, key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise format_error(f"a number {key}", where, repr(text[:40])) from None


def _pose(numbers: Mapping[str, float]) -> Float64[np.ndarray, "3 4"]:
    angles = np.radians([-numbers["heading"], numbers["pitch"], numbers["roll"]])
    (cz, cx, cy), (sz, sx, sy) = np.cos(angles), np.sin(angles)
    heading = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    pitch = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    roll = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rotation = heading @ pitch @ roll @ OPENCV_FROM_OPENGL[:3, :3]
    return np.column_stack([rotation, [numbers[key] for key in ("x", "y", "alt")]])


def _lens(numbers: Mapping[str, float], size: Size) -> Lens:
    px, py, k1, k2, k3, k4, t1, t2 = (
        numbers.get(key, 0.0) for key in ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
    )
    scale = float(max(size))
    f, center = numbers["f"] * scale / _FILM, (size[0] / 2 + px * scale, size[1] / 2 + py * scale)
    return with_r8(brown((f, f), center, (k1, k2, k3), (t1, t2)), k4)
