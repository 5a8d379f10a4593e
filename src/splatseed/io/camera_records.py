"""Cameras and poses in a scene's files: checked records, and images left out for lack of them.

``where`` is the file, line or record that an error names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from splatseed.camera import MODELS, PANORAMA, Intrinsics, quat_from_rotation, rotation_from_quat
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import COPY_AGAIN
from splatseed.text import agreeing, counted, name_some

MAX_ID = 2**32 - 1
"""The largest camera id, image id or feature index: 32 bits in COLMAP's binary form."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts camera axes between OpenGL and OpenCV."""
_MAX_SIZE = 2**31 - 1
_RIGID_TOLERANCE = 1e-3  # of rotation @ rotation.T against the identity
_EXACT = 1e-12  # of the same, of a rotation in double precision
_NORM_SLACK = 0.01  # of the length of a quaternion with four digits
_NORM_RANGE = (1e-100, 1e100)  # inside it the square of a quaternion's norm is a normal float


class NotFiniteError(SceneFormatError):
    """A camera or pose is NaN, infinite or zero; the scene can be used without its images."""


Lens: TypeAlias = tuple[str, tuple[float, ...]]
"""COLMAP's model and parameters."""
Unusable: TypeAlias = dict[Any, NotFiniteError]
"""Why records were left out, by camera id or image name."""


def make_intrinsics(
    where: str, camera_id: int, model: str, width: int, height: int, params: Sequence[float]
) -> Intrinsics:
    """Make a checked camera record; raise ``NotFiniteError`` for parameters that are not usable."""
    check_record(0 <= camera_id <= MAX_ID, f"a camera id from 0 to {MAX_ID}", where, camera_id)
    fits = 0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE
    check_record(fits, "a camera size in pixels", where, f"{width} x {height}")
    require_finite(
        all(map(math.isfinite, params)), "finite camera parameters", where, tuple(params)
    )
    try:
        camera = Intrinsics(camera_id, model, width, height, tuple(params))
    except SceneFormatError as error:
        expected = f"{error.expected} in {where}"
        raise SceneFormatError(expected, found=error.found, fix=error.fix) from None
    what, count = ("size", 2) if camera.is_panorama else ("focal length", MODELS[model].num_focal)
    lengths = camera.params[:count]
    found = ", ".join(f"{each:g}" for each in lengths)
    require_finite(min(lengths) > 0, f"a {what} above 0", where, found)
    return camera


def brown(
    focal: tuple[float, float],
    center: tuple[float, float],
    radial: Sequence[float] = (),
    tangential: tuple[float, float] = (0.0, 0.0),
) -> Lens:
    """Return the simplest of COLMAP's models for Brown and Conrady's with OpenCV's p1 and p2.

    ``radial`` are the coefficients of r^2, r^4 and r^6.
    """
    k1, k2, k3 = (*radial, 0.0, 0.0, 0.0)[:3]
    if k3:
        return "FULL_OPENCV", (*focal, *center, k1, k2, *tangential, k3, 0.0, 0.0, 0.0)
    if any((k1, k2, *tangential)):
        return "OPENCV", (*focal, *center, k1, k2, *tangential)
    return "PINHOLE", (*focal, *center)


def fisheye(
    focal: tuple[float, float],
    center: tuple[float, float],
    radial: Sequence[float] = (),
    tangential: tuple[float, float] = (0.0, 0.0),
) -> Lens:
    """Return COLMAP's model of an equidistant lens with terms of theta^2 to theta^8."""
    k1, k2, k3, k4 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    if any(tangential):
        return "THIN_PRISM_FISHEYE", (*focal, *center, k1, k2, *tangential, k3, k4, 0.0, 0.0)
    return "OPENCV_FISHEYE", (*focal, *center, k1, k2, k3, k4)


def panorama(width: float, height: float) -> Lens:
    """Return COLMAP's model of a panorama of all directions, whose parameters are its size."""
    return PANORAMA.name, (float(width), float(height))


def check_pose(pose: Sequence[float], of: str, where: str) -> None:
    """Raise a ``NotFiniteError`` unless a wxyz quaternion and a translation make a pose."""
    require_finite(all(map(math.isfinite, pose)), f"a finite pose {of}", where, tuple(pose))
    is_rotation = _NORM_RANGE[0] < math.hypot(*pose[:4]) < _NORM_RANGE[1]
    require_finite(is_rotation, f"a rotation quaternion {of}", where, tuple(pose[:4]))


def check_unit_quat(quat: Float64[np.ndarray, " 4"], where: str, fix: str) -> None:
    """Raise a ``SceneFormatError`` unless a wxyz quaternion has length 1, but for rounding."""
    if abs(np.linalg.norm(quat) - 1) > _NORM_SLACK:
        found = " ".join(f"{each:g}" for each in quat[[1, 2, 3, 0]])
        raise SceneFormatError(f"qx qy qz qw of length 1 in {where}", found=found, fix=fix)


def rigid_pose(
    where: str, world_from_cam: Float64[np.ndarray, "R 4"]
) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """Convert ``world_from_cam`` to the quaternion and translation of ``cam_from_world``.

    Raises ``SceneFormatError`` unless it is rigid; a fourth row must be 0, 0, 0, 1.
    """
    rotation = world_from_cam[:3, :3].T
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers fail the check below
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        proper = np.linalg.det(rotation) > 0
        scale = np.linalg.norm(rotation, axis=1)
        uniform = np.ptp(scale) <= _RIGID_TOLERANCE * scale.max()
    affine = np.allclose(world_from_cam[3:], [[0, 0, 0, 1]], atol=_RIGID_TOLERANCE)
    if not (off <= _RIGID_TOLERANCE and proper and affine):
        expected = f"a rotation and a translation as world_from_cam in {where}"
        found, fix = "a sheared one", "Correct the file, or export the scene again."
        if not affine:
            row = ", ".join(f"{value:g}" for value in world_from_cam[3])
            found = f"{row} as its last row instead of 0, 0, 0, 1"
        elif not proper:
            found, fix = "a mirrored one", f"An axis or its sign is wrong. {fix}"
        elif uniform and abs(scale[0] - 1) > _RIGID_TOLERANCE / 4:
            found, fix = f"one scaled by {scale[0]:.4g}", "Divide its 3 x 3 part by that."
        raise SceneFormatError(expected, found=found, fix=fix)
    quat = quat_from_rotation(rotation)
    if off > _EXACT:  # else the centre would move: by a metre, for six digits at a million
        rotation = rotation_from_quat(quat)
    return quat, -rotation @ world_from_cam[:3, 3]


def unusable_images(unusable: Unusable) -> dict[str, NotFiniteError]:
    """Return the images among the records that were left out."""
    return {name: error for name, error in unusable.items() if isinstance(name, str)}


def check_enough(unusable: Mapping[str, NotFiniteError], used: int) -> None:
    """Raise the first image's error if fewer than half of the images are usable."""
    if len(unusable) > used:
        raise next(iter(unusable.values()))


def unusable_findings(unusable: Mapping[str, NotFiniteError], used: int) -> list[Finding]:
    """Report images that are left out, if any."""
    if not unusable:
        return []
    count, whose = len(unusable), agreeing(len(unusable), "its", "their")
    which = f"{count} of {count + used} images {agreeing(count, 'is', 'are')} left out"
    why = f"{whose} pose or camera is not finite, or zero"
    text = f"{which} ({name_some([*unusable], 3)}): {why}."
    return [Finding("unusable-images", text, subjects=tuple(unusable))]


def left_out(kind: str, noun: str, lacking: str, names: Sequence[str]) -> list[Finding]:
    """Report the things of these names that are left out for lack of something, if any."""
    if not names:
        return []
    subject = f"{counted(len(names), noun)} without {lacking}"
    text = f"{subject} {agreeing(len(names), 'is', 'are')} left out, such as {names[0]}."
    return [Finding(kind, text, subjects=tuple(names))]


def check_record(holds: bool, expected: str, where: str, found: object) -> None:
    """Raise a ``SceneFormatError`` for a record unless a condition holds."""
    if not holds:
        raise format_error(expected, where, str(found))


def require_finite(holds: bool, expected: str, where: str, found: object) -> None:
    """Raise a ``NotFiniteError`` for a record unless a condition holds."""
    if not holds:
        raise NotFiniteError(f"{expected} in {where}", found=str(found), fix=COPY_AGAIN)


def format_error(expected: str, where: str, found: str) -> SceneFormatError:
    """Make the error for a record that is not as expected."""
    return SceneFormatError(f"{expected} in {where}", found=found, fix=COPY_AGAIN)
