"""Which way is up: the vertical of a capture, and cameras of photographs that are not upright.

A phone stores portrait photographs in landscape, with a turn in EXIF, and poses are those of the
pixels as stored: of sideways cameras. Where copies have lost EXIF, poses show it: people turn about
the vertical more than they look up and down, so the axis of the image that stays the same from
camera to camera is the vertical one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.io.photograph_checks import original_orientation
from splatseed.scene import Image, Scene

_EXIF_TURNS = {6: 1, 3: 2, 8: 3}
"""Clockwise quarter turns by EXIF's orientation; cameras do not mirror photographs."""
_QUARTER = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""The new x is the old -y, up; the new y is the old x."""


@dataclass(frozen=True)
class UprightSettings:
    """When cameras are sideways. The *spread* of an axis is 1 - its length in the mean camera."""

    # In nine upright captures the spread of x is 2.8 to 24 times that of y.
    min_ratio: float = 2.0  # of the spread of y to that of x
    min_spread: float = 0.05  # of y; below, cameras look one way, and poses show no vertical
    looks_down: float = 0.17  # mean sine of the pitch above which cameras would look up
    min_up: float = 1e-6  # length of the mean up direction below which the cameras' cancel
    # Of the mean up axis against horizontal x axes, which decide if these spread over 5 degrees.
    up_weight: float = 0.005


UPRIGHT = UprightSettings()


def quarter_turns(images: Sequence[Image]) -> list[int]:
    """Return the clockwise quarter turns that make each image upright.

    They follow EXIF if it turns any photograph, else the poses, which turn all alike: if cameras
    would look up from there, the right of sideways images is up, else the left, as in phones.
    """
    turns = [_exif_turn(image) for image in images]
    if any(turns) or not images:
        return turns
    rotations = [image.camera.cam_from_world[:3, :3] for image in images]
    x, y, forward = np.mean(rotations, axis=0)
    spread_x, spread_y = 1 - np.linalg.norm(x), 1 - np.linalg.norm(y)
    if spread_y < UPRIGHT.min_spread or spread_y < UPRIGHT.min_ratio * spread_x:
        return turns
    pitch = forward @ -x / np.linalg.norm(x)  # as if the left were up
    return [1 if pitch < UPRIGHT.looks_down else 3] * len(images)


def turned(camera: Camera, quarters: int) -> Camera:
    """Turn a camera about its axis, so that its image turns clockwise by quarter turns."""
    for _ in range(quarters):
        (fx, _, cx), (_, fy, cy) = camera.K[:2]
        K = np.array([[fy, 0, camera.height - cy], [0, fx, cx], [0, 0, 1.0]])
        camera = Camera(K, camera.height, camera.width, _QUARTER @ camera.cam_from_world)
    return camera


def up_direction(cameras: Sequence[Camera]) -> Float64[np.ndarray, " 3"]:
    """Up direction of upright cameras; without any, or if they cancel, -y, as in COLMAP.

    Upright cameras may look down, but their x axes are horizontal: of all directions near the mean
    up axis, the one most nearly at right angles to them.
    """
    rotations = np.array([camera.cam_from_world[:3, :3] for camera in cameras]).reshape(-1, 3, 3)
    right, up = rotations[:, 0], -rotations[:, 1].mean(axis=0) if len(cameras) else np.zeros(3)
    length = np.linalg.norm(up)
    if not length > UPRIGHT.min_up:
        return np.array([0.0, -1.0, 0.0])
    # min over u: mean (x_i . u)^2 + weight |u - up|^2
    normal = right.T @ right / len(right) + UPRIGHT.up_weight * np.eye(3)
    up = np.linalg.solve(normal, UPRIGHT.up_weight * up / length)
    return np.asarray(up / np.linalg.norm(up))


def vertical(scene: Scene | None, cameras: Sequence[Camera]) -> Float64[np.ndarray, " 3"]:
    """Up direction of a scene: by gravity where a phone has recorded it, else by its cameras."""
    if scene is not None and scene.source.format == "phone":
        return np.array([0.0, 1.0, 0.0])
    return up_direction(cameras)


def _exif_turn(image: Image) -> int:
    if image.folder is None or image.lens.width <= image.lens.height:
        return 0  # sensors are wide: a tall photograph was turned, though its EXIF may still say so
    return _EXIF_TURNS.get(original_orientation(image), 0)
