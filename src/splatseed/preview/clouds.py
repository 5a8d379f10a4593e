"""Pages of clouds: before and after, every method, distances from the true surface.

Notation: a picture is uint8 [H, W, 3]. Promise: the clouds of a page are seen by one of the scene's
own cameras, if it has any; files appear whole or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.errors import PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.preview.colors import color_bar, heat
from splatseed.preview.page import GRID_SIDE, Tile, columns_for, write_grid
from splatseed.preview.photographs import photograph_at
from splatseed.preview.points import render_points
from splatseed.scene import Scene
from splatseed.views.viewpoint import choose_camera, choose_image

PAIR_SIDE = 800


def preview_pair(
    scene: Scene, upsampled: PointCloud, path: Path | str, *, title: str = "upsampled"
) -> Path:
    """Write a picture of the scene's points beside the upsampled ones, from one camera.

    Args:
        scene: The scene as read.
        upsampled: The points made from it.
        path: The PNG to write.
        title: Describes the upsampled points, such as ``"mls, 8x"``.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: The scene has no finite points.
    """
    camera = choose_camera(scene)
    clouds = {"original": scene.points, title: upsampled}
    return write_grid(_cloud_tiles(clouds, camera, PAIR_SIDE), path, columns=2)


def preview_methods(scene: Scene, clouds: Mapping[str, PointCloud], path: Path | str) -> Path:
    """Write a grid: the photograph if there is one, the scene's points, and each cloud.

    Args:
        scene: The scene as read.
        clouds: Upsampled points by label, drawn in this order.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: The scene has no finite points.
    """
    camera = choose_camera(scene)
    tiles = _cloud_tiles({"original": scene.points, **clouds}, camera, GRID_SIDE)
    height, width = tiles[0].picture.shape[:2]
    image = choose_image(scene)
    photo = None if image is None else photograph_at(scene, image, (width, height))
    if photo is not None:
        tiles.insert(0, Tile("photograph", photo))
    return write_grid(tiles, path, columns=columns_for(len(tiles)))


def preview_errors(
    clouds: Mapping[str, PointCloud],
    distances: Mapping[str, Float64[np.ndarray, " N"]],
    camera: Camera,
    path: Path | str,
    *,
    limit: float = 1.0,
    unit: str = "spacings",
) -> Path:
    """Write a grid of clouds whose points are coloured by their distance to the true surface.

    Args:
        clouds: Points by label; usually only the new ones.
        distances: For each label the distance of every point, in ``unit``.
        camera: The camera to look from.
        path: The PNG to write.
        limit: Distances from this on have the last colour of the colour bar.
        unit: Unit of the colour bar; by default the originals' spacing h.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: Distances and points differ in number.
    """
    colored = {
        label: cloud.replace(rgb=heat(_matching(distances[label], cloud, label) / limit))
        for label, cloud in clouds.items()
    }
    tiles = [
        Tile(f"{tile.label}: mean error {distances[label].mean():.2f} {unit}", tile.picture)
        for label, tile in zip(colored, _cloud_tiles(colored, camera, GRID_SIDE), strict=True)
    ]
    bar = color_bar(f"0 {unit}", f"{limit:g} {unit} or more from the surface")
    return write_grid(tiles, path, columns=columns_for(len(tiles)), footer=bar)


def _matching(distances: np.ndarray, cloud: PointCloud, label: str) -> np.ndarray:
    if len(distances) != len(cloud):
        raise PointCloudError(
            f"one distance for each of the {len(cloud)} points of {label!r}",
            found=f"{len(distances)}",
            fix="Pass the distances of the same points.",
        )
    return np.asarray(distances)


def _cloud_tiles(clouds: Mapping[str, PointCloud], camera: Camera, side: int) -> list[Tile]:
    scale = side / max(camera.width, camera.height)
    return [
        Tile(f"{label}   {len(cloud):,} points", render_points(cloud, camera, scale=scale))
        for label, cloud in clouds.items()
    ]
