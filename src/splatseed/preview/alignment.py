"""The result of aligning a cloud: a photograph, the cloud from its camera, and the residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from splatseed.pointcloud import PointCloud
from splatseed.preview.page import Tile, write_grid
from splatseed.preview.photographs import photograph_at
from splatseed.preview.points import render_points
from splatseed.scene import Scene
from splatseed.views.viewpoint import choose_camera, choose_image

SIDE = 800
GREY = 150
NEAR, FAR = np.array([0, 114, 178]), np.array([213, 94, 0])
"""Colours of points on the cloud and of those off it."""


def preview_alignment(
    scene: Scene,
    cloud: Float64[np.ndarray, "N 3"],
    rgb: UInt8[np.ndarray, "N 3"] | None,
    marks: Float64[np.ndarray, "M 3"],
    share: Float64[np.ndarray, " M"],
    path: Path | str,
) -> Path:
    """Write a page of photograph, cloud and residuals, side by side.

    Args:
        scene: One of its cameras is chosen.
        cloud: A sample of the cloud in the scene's frame.
        rgb: Its colours; grey without.
        marks: The scene's points that it was aligned with.
        share: For each, 0 on the cloud to 1 where it does not count.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
    """
    camera, image = choose_camera(scene), choose_image(scene)
    scale = SIDE / max(camera.width, camera.height)
    colors = np.full(cloud.shape, GREY, np.uint8) if rgb is None else rgb
    laid = render_points(PointCloud(cloud, colors), camera, scale=scale)
    blend = np.clip(share, 0, 1)[:, None]
    shades = np.rint((1 - blend) * NEAR + blend * FAR).astype(np.uint8)
    off = render_points(PointCloud(marks, shades), camera, scale=scale)
    size = (laid.shape[1], laid.shape[0])
    photograph = None if image is None else photograph_at(scene, image, size)
    tiles = [] if photograph is None else [Tile("a photograph", photograph)]
    tiles += [
        Tile("the cloud from its camera, as aligned", laid),
        Tile("the scene's points: blue on the cloud, orange off it", off),
    ]
    return write_grid(tiles, path, columns=len(tiles))
