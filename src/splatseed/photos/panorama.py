"""Equirectangular panoramas, and the perspective faces that are cut from them.

A panorama of W x H pixels shows the direction of longitude a (to the right) and latitude b (down),
both 0 along the camera's z axis, at u = W (1/2 + a / 2 pi), v = H (1/2 + b / pi): COLMAP's
EQUIRECTANGULAR, and the same as nerfstudio's and LichtFeld Studio's in OpenGL's axes. The *faces*
are those of a cube, each with a margin that the next one shows, too, and with the angular
resolution that the panorama has along its horizon.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatseed.camera import FACE_HALF_VIEW, Intrinsics
from splatseed.frozen import read_only_view
from splatseed.projection import denormalized, normalized, pixel_centers

FACES: dict[str, Float64[np.ndarray, "3 3"]] = {
    "front": np.array([(1.0, 0, 0), (0, 1, 0), (0, 0, 1)]),
    "right": np.array([(0.0, 0, -1), (0, 1, 0), (1, 0, 0)]),
    "back": np.array([(-1.0, 0, 0), (0, 1, 0), (0, 0, -1)]),
    "left": np.array([(0.0, 0, 1), (0, 1, 0), (-1, 0, 0)]),
    "up": np.array([(1.0, 0, 0), (0, 0, 1), (0, -1, 0)]),
    "down": np.array([(1.0, 0, 0), (0, 0, -1), (0, 1, 0)]),
}
"""Rotation of each face: face_from_panorama."""
_BAND = 256  # rows of a face computed at a time, which bounds the memory of their rays


def face_lens(panorama: Intrinsics, camera_id: int = 1) -> Intrinsics:
    """Return the camera of a panorama's faces, PINHOLE and square."""
    focal = panorama.params[0] / (2 * math.pi)  # pixels per radian along the horizon
    center = max(1, round(focal * math.tan(math.radians(FACE_HALF_VIEW))))
    params = (focal, focal, float(center), float(center))
    return Intrinsics(camera_id, "PINHOLE", 2 * center, 2 * center, params)


def project_directions(
    panorama: Intrinsics, xyz: Float64[np.ndarray, "*B 3"]
) -> Float64[np.ndarray, "*B 2"]:
    """Return the pixels of directions of any length in a panorama's axes."""
    x, y, z = np.moveaxis(xyz, -1, 0)
    turns = np.stack([np.arctan2(x, z) / (2 * np.pi), np.arctan2(y, np.hypot(x, z)) / np.pi], -1)
    return np.asarray((turns + 0.5) * panorama.params)


def pixel_directions(
    panorama: Intrinsics, uv: Float64[np.ndarray, "*B 2"]
) -> Float64[np.ndarray, "*B 3"]:
    """Return the unit directions of a panorama's pixels, in its axes."""
    a, b = np.moveaxis((uv / np.array(panorama.params) - 0.5) * (2 * np.pi, np.pi), -1, 0)
    return np.stack([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)], axis=-1)


def face_directions(lens: Intrinsics, face: str, rows: slice) -> Float64[np.ndarray, "rows W 3"]:
    """Return the directions of some rows of a face's pixels, in the panorama's axes."""
    uv = pixel_centers(rows.stop - rows.start, lens.width) + np.array([0, rows.start])
    xy = normalized(lens.K, uv)
    return np.asarray(np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ FACES[face])


def cut_face(
    pixels: UInt8[np.ndarray, "H W 3"], panorama: Intrinsics, face: str
) -> UInt8[np.ndarray, "S S 3"]:
    """Resample a panorama as the camera of ``face_lens`` takes it in the direction of a face."""
    from splatseed.photos._kernels import resample  # noqa: PLC0415  (Numba, for which --help waits)

    lens = face_lens(panorama)
    # A column of the other side at each end: interpolation goes on where the panorama closes.
    closed = read_only_view(np.concatenate([pixels[:, -1:], pixels, pixels[:, :1]], axis=1))
    out = np.zeros((lens.height, lens.width, 3), np.uint8)
    known = np.zeros(out.shape[:2], np.bool_)
    for first in range(0, lens.height, _BAND):
        rows = slice(first, min(first + _BAND, lens.height))
        uv = project_directions(panorama, face_directions(lens, face, rows)) + np.array([1.0, 0.0])
        resample(closed, uv, out[rows], known[rows])
    return out


def face_features(
    panorama: Intrinsics, uv: Float64[np.ndarray, "M 2"]
) -> tuple[Int64[np.ndarray, " M"], Float64[np.ndarray, "M 2"]]:
    """Return the face that shows each pixel of a panorama best, by number, and the pixel there."""
    turned = np.einsum("fij,mj->fmi", np.stack([*FACES.values()]), pixel_directions(panorama, uv))
    face = turned[..., 2].argmax(axis=0)
    xyz = turned[face, np.arange(len(uv))]
    return face, denormalized(face_lens(panorama).K, xyz[:, :2] / xyz[:, 2:])
