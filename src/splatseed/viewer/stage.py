"""What the browser itself draws: points by origin, and cameras with their photographs.

Promise: each browser gets its own copy, so that the switches of one do not affect another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.pointcloud import PointCloud
from splatseed.preview.origins import origin_colors
from splatseed.scene import Image, Scene
from splatseed.splat.gaussians import TrainingFrame
from splatseed.upsample.registry import origin_name
from splatseed.viewer.canvas import stage_pose

MOST_CAMERAS = 400
"""Most cameras that are drawn; of more, an even subset."""
FRUSTUM, LEAST_FRUSTUM, MOST_FRUSTUM = 0.5, 0.008, 0.05
"""Size of a camera relative to the distance to the next one, and its bounds on the stage."""
POINT_PIXELS = 1.4
"""Diameter of a point in pixels, as the first camera sees it in a picture 1000 pixels high."""
TEST_COLOR, TRAIN_COLOR = (213, 94, 0), (0, 114, 178)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one origin, on the stage.

    Args:
        name: The origin's name.
        xyz: Positions on the stage, [N, 3].
        rgb: Photographed colours.
        color: The origin's colour.
        count: How many the scene has; ``xyz`` may hold only some of them.
    """

    name: str
    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    color: tuple[int, int, int]
    count: int


def clouds_of(points: PointCloud, frame: TrainingFrame, most: int) -> list[Cloud]:
    """A cloud's finite points by origin, moved onto the stage and thinned evenly to ``most``."""
    every = max(1, -(-len(points) // most))
    finite = points.select(points.finite)
    codes, counts = np.unique(finite.source, return_counts=True)
    clouds = []
    for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
        part = finite.select(np.flatnonzero(finite.source == code)[::every])
        color = tuple(origin_colors(np.array([code], np.uint8))[0].tolist())
        xyz = frame.points_from_world(part.xyz)
        clouds.append(Cloud(origin_name(code), xyz, part.rgb, color, count))
    return clouds


def point_size(clouds: Sequence[Cloud], images: Sequence[Image], frame: TrainingFrame) -> float:
    """The diameter on the stage at which the first camera sees a point a few pixels wide."""
    xyz = np.concatenate([cloud.xyz[:: max(1, len(cloud.xyz) // 5000)] for cloud in clouds])
    eye = stage_pose(images[0].camera, frame)[1] if images else 3 * np.ones(3)
    return float(np.median(np.linalg.norm(xyz - eye, axis=1))) * POINT_PIXELS / 1000


def add_clouds(scene: Any, clouds: Sequence[Cloud], size: float) -> dict[str, Any]:
    """Add clouds to a browser's scene; returns the handles by origin."""
    return {
        cloud.name: scene.add_point_cloud(
            f"/points/{cloud.name}",
            cloud.xyz,
            cloud.rgb,
            point_size=size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        for cloud in clouds
    }


def add_cameras(
    gui_scene: Any, scene: Scene, frame: TrainingFrame, fly: Callable[[Image], None], every: int = 8
) -> list[tuple[Image, Any]]:
    """Add a frustum for each camera to a browser's scene; a click on one flies there.

    Args:
        gui_scene: The browser's scene.
        scene: The scene whose cameras to add.
        frame: The stage.
        fly: Called with the image whose camera was clicked.
        every: Every ``every``-th image, sorted by name, is a test view and gets another colour.
    """
    tested = {image.name for image in scene.split(every)[1]}
    images = scene.images[:: max(1, -(-len(scene.images) // MOST_CAMERAS))]
    size = _frustum_size(images, frame)
    handles = []
    for i, image in enumerate(images):
        camera = image.camera
        wxyz, position = stage_pose(camera, frame)
        handle = gui_scene.add_camera_frustum(
            f"/cameras/{i}",
            fov=2 * float(np.arctan(camera.height / 2 / camera.K[1, 1])),
            aspect=camera.width / camera.height,
            scale=size,
            thickness=1.5,
            thickness_units="screen",
            color=TEST_COLOR if image.name in tested else TRAIN_COLOR,
            wxyz=wxyz,
            position=position,
        )
        handle.on_click(lambda _, image=image: fly(image))
        handles.append((image, handle))
    return handles


def _frustum_size(images: Sequence[Image], frame: TrainingFrame) -> float:
    """The largest size at which neighbouring cameras do not overlap."""
    centers = np.array([stage_pose(image.camera, frame)[1] for image in images])
    if len(centers) < 2:
        return MOST_FRUSTUM
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    return float(np.clip(FRUSTUM * np.median(gaps.min(axis=1)), LEAST_FRUSTUM, MOST_FRUSTUM))
