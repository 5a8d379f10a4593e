"""COLMAP models in text form: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

Notation: ``rows`` are the fields of the data lines, ``numbers`` their line numbers from 1. Lines
that begin with ``#`` and blank ones are skipped, except that the line after an image's is always
its features and may be blank. Promise: what one reads is what the binary form of the same model
gives, to the last bit; a malformed file raises a single error that names the file and the line.
Python loops over lines are the price of the format. The text form is read but never written:
trainers load the binary one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.io.colmap.model import (
    MAX_ID,
    check_unique,
    make_image,
    make_intrinsics,
    make_points,
)
from splatseed.io.files import COPY_AGAIN, read_bytes
from splatseed.pointcloud import PointCloud
from splatseed.scene import NO_POINT, Image, Observations, Tracks


def read_cameras(path: Path) -> tuple[Intrinsics, ...]:
    """The camera records of a ``cameras.txt``, in file order.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable or malformed, or a camera model is unknown.
    """
    numbers, rows = _data_rows(path)
    cameras = tuple(_parse_camera(path, *numbered) for numbered in zip(numbers, rows, strict=True))
    ids = np.array([camera.camera_id for camera in cameras], np.int64)
    check_unique("camera id", ids, path, lambda i: f"line {numbers[i]}")
    return cameras


def _parse_camera(path: Path, number: int, row: list[str]) -> Intrinsics:
    try:
        camera_id, width, height = int(row[0]), int(row[2]), int(row[3])
        params = tuple(map(float, row[4:]))
    except (ValueError, IndexError):
        raise _bad(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", row) from None
    return make_intrinsics(f"{path}, line {number}", camera_id, row[1], width, height, params)


def read_images(path: Path, intrinsics: Sequence[Intrinsics]) -> tuple[Image, ...]:
    """The image records of an ``images.txt``, in file order, with their features.

    A name may hold spaces: it is the rest of its line.

    Args:
        path: The file.
        intrinsics: The camera records that the images refer to.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable or malformed, a pose is not finite, or an image names a
            camera that is not there.
    """
    cameras = {camera.camera_id: camera for camera in intrinsics}
    lines = _lines(path)
    images, numbers = [], []
    for number, line in lines:
        if _is_data(line):
            # The last image of a file cut by an editor may lack its empty feature line.
            _, features = next(lines, (number + 1, ""))
            observations = _parse_features(path, number + 1, features.split())
            images.append(_parse_image(path, number, line, cameras, observations))
            numbers.append(number)
    ids = np.array([image.image_id for image in images], np.int64)
    check_unique("image id", ids, path, lambda i: f"line {numbers[i]}")
    names = np.array([image.name for image in images], str)
    check_unique("image name", names, path, lambda i: f"line {numbers[i]}")
    return tuple(images)


def _parse_image(
    path: Path,
    number: int,
    line: str,
    cameras: dict[int, Intrinsics],
    observations: Observations,
) -> Image:
    row = line.strip().split(maxsplit=9)
    try:
        image_id, pose, camera_id, name = int(row[0]), row[1:8], int(row[8]), row[9]
        values = tuple(map(float, pose))
    except (ValueError, IndexError):
        raise _bad(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", row) from None
    return make_image(
        f"{path}, line {number}",
        cameras,
        image_id=image_id,
        camera_id=camera_id,
        name=name,
        pose=values,
        observations=observations,
    )


def _parse_features(path: Path, number: int, row: list[str]) -> Observations:
    fields = np.array(row, dtype=object)
    try:
        triples = fields.reshape(-1, 3)
        xy, point_ids = triples[:, :2].astype(np.float64), triples[:, 2].astype(np.int64)
    except (ValueError, OverflowError):
        raise _bad(path, number, "X Y POINT3D_ID triples", row) from None
    if (point_ids < NO_POINT).any():
        raise _bad(path, number, "point ids from -1 (none)", [str(point_ids.min())])
    return Observations(xy, point_ids)


def read_points3d(path: Path) -> tuple[PointCloud, Tracks]:
    """The points of a ``points3D.txt`` in file order, and their tracks.

    Coordinates may be NaN or infinite; nothing is repaired here.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable or malformed, or a point id occurs twice or exceeds
            2^63 - 1.
    """
    numbers, rows = _data_rows(path)
    for number, row in zip(numbers, rows, strict=True):
        if len(row) < 8 or len(row) % 2:
            raise _bad(path, number, "POINT3D_ID X Y Z R G B ERROR and IMAGE_ID POINT2D_IDX", row)
    rgb = _flat(path, numbers, [row[4:7] for row in rows], 255).reshape(-1, 3)
    pairs = _flat(path, numbers, [row[8:] for row in rows], MAX_ID).reshape(-1, 2).astype(np.uint32)
    lengths = [(len(row) - 8) // 2 for row in rows]
    tracks = Tracks(
        point_ids=_flat(path, numbers, [row[:1] for row in rows], 2**63 - 1),
        xyz=_flat(path, numbers, [row[1:4] for row in rows]).reshape(-1, 3),
        errors=_flat(path, numbers, [row[7:8] for row in rows]),
        offsets=np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64),
        image_ids=pairs[:, 0].copy(),
        point2d_idx=pairs[:, 1].copy(),
    )
    return make_points(path, lambda i: f"line {numbers[i]}", rgb.astype(np.uint8), tracks)


def _flat(
    path: Path,
    numbers: Sequence[int],
    columns: Sequence[list[str]],
    largest: int | None = None,
) -> np.ndarray:
    """The fields of all lines, one after another, as float64, or as int64 up to ``largest``."""
    dtype, expected = (np.float64, "numbers") if largest is None else (np.int64, "integers from 0")

    def convert(fields: Sequence[str]) -> np.ndarray | None:
        try:
            values = np.array(fields, dtype)
        except (ValueError, OverflowError):
            return None
        wrong = largest is not None and ((values < 0) | (values > largest)).any()
        return None if wrong else values

    values = convert([field for column in columns for field in column])
    if values is None:  # only a file that is refused anyway pays for locating its first bad line
        i = next(i for i, column in enumerate(columns) if convert(column) is None)
        raise _bad(
            path, numbers[i], f"{expected} to {largest}" if largest else expected, columns[i]
        )
    return values


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The numbered lines of a UTF-8 file, its byte order mark left out."""
    raw = read_bytes(path)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        number = raw.count(b"\n", 0, error.start) + 1
        raise _bad(path, number, "UTF-8 text", [repr(raw[error.start : error.end])]) from None
    return iter(enumerate(text.split("\n"), start=1))


def _is_data(line: str) -> bool:
    stripped = line.lstrip()
    return bool(stripped) and not stripped.startswith("#")


def _data_rows(path: Path) -> tuple[list[int], list[list[str]]]:
    """The line numbers and the fields of all data lines."""
    data = [(number, line) for number, line in _lines(path) if _is_data(line)]
    return [number for number, _ in data], [line.split() for _, line in data]


def _bad(path: Path, number: int, expected: str, row: list[str]) -> SceneFormatError:
    fields = " ".join(row)
    line = repr(fields if len(fields) <= 80 else f"{fields[:77]}...") if row else "an empty line"
    return SceneFormatError(f"{expected} in {path}, line {number}", found=line, fix=COPY_AGAIN)
