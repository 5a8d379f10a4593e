"""Scenes in national grids, whose coordinates single precision cannot hold, moved around 0.

Promise: cameras and tracked points are moved in double precision; nothing is turned or scaled.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from splatseed.errors import ParameterError
from splatseed.scene import Scene

RESOLUTION = 1e-4
"""Steps of single precision coarser than this share of the cameras' spread show in renders."""


def offset_of(scene: Scene) -> Float64[np.ndarray, " 3"]:
    """The middle of the cameras, in whole units."""
    centers = np.array([image.camera.center for image in scene.images])
    return np.asarray(np.rint(centers.mean(axis=0)))


def recentred(scene: Scene, offset: Float64[np.ndarray, " 3"]) -> Scene:
    """A scene moved by ``-offset``.

    Files beside the model that hold positions no longer belong to it.
    """
    images = tuple(
        replace(image, translation=image.translation + image.camera.cam_from_world[:3, :3] @ offset)
        for image in scene.images
    )
    xyz, tracks = scene.points.xyz.astype(np.float64), scene.tracks
    if tracks is not None:
        xyz[: len(tracks)] = tracks.xyz
        tracks = replace(tracks, xyz=tracks.xyz - offset)
    source = scene.source and replace(scene.source, model_dir=None, transforms_path=None)
    points = scene.points.replace(xyz=(xyz - offset).astype(np.float32))
    return replace(scene, images=images, points=points, tracks=tracks, source=source)


def check_precision(scene: Scene) -> None:
    """Refuse a scene whose coordinates single precision cannot hold.

    Raises:
        ParameterError: It is far from 0.
    """
    if not scene.images:
        return
    centers = np.array([image.camera.center for image in scene.images])
    spread = float(np.ptp(centers, axis=0).max())
    step = float(np.spacing(np.float32(np.abs(centers).max())))
    if step > RESOLUTION * spread > 0:
        raise ParameterError(
            "a scene near 0: seeds are written in single precision",
            found=f"cameras at {np.abs(centers).max():,.0f}, where it has steps of {step:.2g}",
            fix="Pass --recenter: it writes scene and cloud around 0, and the offset to a file.",
        )
