"""What the exports of phone apps share: ARKit's poses and cameras, one of each per photograph.

ARKit's ``ARCamera.transform`` is ``world_from_cam`` in OpenGL axes (x right, y up, z back), metres,
y up. Its ``intrinsics`` count pixels from the centre of the first one: its projection matrix adds
half a pixel to the principal point. Photographs are stored as the sensor has them, unrotated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.camera_records import (
    OPENCV_FROM_OPENGL,
    NotFiniteError,
    check_enough,
    make_intrinsics,
    rigid_pose,
    unusable_findings,
)
from splatseed.io.files import read_json
from splatseed.io.origin import recentered
from splatseed.io.photograph_checks import photograph_findings
from splatseed.pointcloud import PointCloud
from splatseed.scene import OPENGL, Image, Scene, SceneSource
from splatseed.text import agreeing, counted

EXPORT_AGAIN = "Export the scan again."
HALF_PIXEL = 0.5
"""From ARKit's principal point, counted from the first pixel's centre, to the image corner's."""
_CONVENTION = f"the app's poses are world_from_cam, {OPENGL}, as ARKit has them"
_MAX_OFFSET = 0.1
"""Largest plausible distance of the principal point from the middle, in image sizes: phones' are
within 0.03, and a photograph resized to 3/4 has 0.17."""


class PhoneFrame(NamedTuple):
    """A photograph's camera and pose as an app stores them."""

    where: str  # file and record, for errors
    size: tuple[int, int]  # width and height to which the pinhole belongs
    pinhole: tuple[float, float, float, float]  # fx fy cx cy, from the image corner, px
    world_from_cam: Float64[np.ndarray, "R 4"]  # OpenGL axes; 3 or 4 rows


def read_phone_scene(
    root: Path,
    track: Path,
    folder: Path,
    names: Iterable[str],
    read: Callable[[str], PhoneFrame],
    findings: Iterable[Finding] = (),
) -> Scene:
    """Make a scene without points of a phone's photographs.

    ``track`` is a file of the poses; ``names`` are the photographs in ``folder``, in order. Those
    for which ``read`` raises ``NotFiniteError`` are left out.
    """
    cameras: dict[tuple[object, ...], Intrinsics] = {}
    images, unusable = list[Image](), dict[str, NotFiniteError]()
    for i, name in enumerate(names):
        try:
            frame = read(name)
            key = (frame.size, frame.pinhole)
            if key not in cameras:
                cameras[key] = _camera(frame, len(cameras) + 1)
            pose = rigid_pose(frame.where, frame.world_from_cam @ OPENCV_FROM_OPENGL)
        except NotFiniteError as error:
            unusable[name] = error
            continue
        images.append(Image(name, i + 1, cameras[key], *pose))
    check_enough(unusable, len(images))
    findings = (
        *findings,
        *unusable_findings(unusable, len(images)),
        *photograph_findings(images, folder, root),
    )
    scene = Scene(
        PointCloud.empty(),
        tuple(images),
        tuple(cameras.values()),
        source=SceneSource("phone", root, track, image_dir=folder, convention=_CONVENTION),
        findings=findings,
        absent=tuple(unusable),
    )
    return recentered(scene)


def without_photograph(count: int, total: int, noun: str) -> list[Finding]:
    """Note records of an export that have no photograph, if any: apps keep more poses."""
    if not count:
        return []
    have = agreeing(count, "has no photograph and is", "have no photograph and are")
    text = f"{count} of {counted(total, noun)} {have} left out."
    return [Finding("missing-photographs", text, "info")]


def _camera(frame: PhoneFrame, camera_id: int) -> Intrinsics:
    camera = make_intrinsics(frame.where, camera_id, "PINHOLE", *frame.size, frame.pinhole)
    offset = np.abs(np.array(frame.pinhole[2:]) / frame.size - 0.5)
    if offset.max() > _MAX_OFFSET:
        width, height = frame.size
        raise SceneFormatError(
            f"a principal point near the middle of {width} x {height} pixels in {frame.where}",
            found=f"({frame.pinhole[2]:g}, {frame.pinhole[3]:g})",
            fix="Use the photographs as the app exported them: not resized, cropped or rotated.",
        )
    return camera


def read_record(path: Path, what: str) -> dict[str, Any]:
    """Read a JSON object; ``what`` it describes is named in errors."""
    record = read_json(path)
    if not isinstance(record, dict):
        raise SceneFormatError(
            f"{path} to be {what}, a JSON object", found=type(record).__name__, fix=EXPORT_AGAIN
        )
    return record


def read_numbers(where: str, record: Mapping[str, Any], keys: Iterable[str]) -> list[float]:
    """Return finite numbers of a record, else raise ``NotFiniteError``."""
    numbers = []
    for key in keys:
        value = record.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            found = "none" if value is None else repr(value)[:80]
            raise SceneFormatError(f"a number {key} in {where}", found=found, fix=EXPORT_AGAIN)
        number = math.inf
        with suppress(OverflowError):  # an integer of hundreds of digits
            number = float(value)
        if not math.isfinite(number):
            raise NotFiniteError(
                f"a finite number {key} in {where}", found=f"{number}", fix=EXPORT_AGAIN
            )
        numbers.append(number)
    return numbers


def read_matrix(
    where: str, record: Mapping[str, Any], key: str, rows: int, columns: int
) -> Float64[np.ndarray, "R C"]:
    """Return a row-major matrix of finite numbers that a record stores as one list.

    Raises ``NotFiniteError`` also if all are 0.
    """
    expected = f"{rows} x {columns} numbers {key}"
    value = record.get(key)
    try:
        matrix: np.ndarray = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        found = repr(value)[:80]
        raise SceneFormatError(f"{expected} in {where}", found=found, fix=EXPORT_AGAIN) from None
    if value is None or matrix.size != rows * columns:
        found = "none" if value is None else f"{matrix.size} numbers"
        raise SceneFormatError(f"{expected} in {where}", found=found, fix=EXPORT_AGAIN)
    if not np.isfinite(matrix).all() or not matrix.any():
        found = "NaN or infinity" if matrix.any() else "only zeros"
        raise NotFiniteError(f"{expected} in {where}", found=found, fix=EXPORT_AGAIN)
    return matrix.reshape(rows, columns)
