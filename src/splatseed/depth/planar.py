"""Depth maps in the pixels and the measure of a camera.

Notation: a ray has unit z in camera axes, so that its length is distance over planar depth. Promise:
a pixel's ray passes through its centre, at +0.5.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int

from splatseed.camera import Camera
from splatseed.depthmap import DepthMap
from splatseed.errors import SceneFormatError
from splatseed.scene import Image

__all__ = ["map_camera", "planar_depth", "ray_length"]


def map_camera(depth: DepthMap, image: Image) -> Camera:
    """The camera of an image in the pixels of its map.

    Raises:
        SceneFormatError: The map has not the shape of the image.
    """
    try:
        return depth.camera(image.camera)
    except SceneFormatError as error:
        raise SceneFormatError(
            f"for {image.name} {error.expected}", found=error.found, fix=error.fix
        ) from None


def ray_length(
    camera: Camera, column: Int[np.ndarray, " ..."], row: Int[np.ndarray, " ..."]
) -> Float64[np.ndarray, " ..."]:
    """Distance over planar depth along the rays through pixels' centres; the two broadcast."""
    x = (column + (0.5 - camera.K[0, 2])) / camera.K[0, 0]
    y = (row + (0.5 - camera.K[1, 2])) / camera.K[1, 1]
    return np.asarray(np.sqrt(x * x + y * y + 1.0))


def planar_depth(
    depth: DepthMap, camera: Camera, scale: float, shift: float, *, unit_ray: bool
) -> tuple[Float32[np.ndarray, "H W"], float]:
    """An array and a number whose product is planar depth in scene units; NaN where unknown.

    The number stands apart because most maps need nothing else, and multiplying a whole map takes
    longer than all that is done with the few pixels that are lifted.

    Args:
        depth: The map.
        camera: The image's camera in pixels of the map.
        scale: As in ``Alignment``.
        shift: Likewise.
        unit_ray: Whether to take planar depth for distance along the ray, the letter of equation 9.
    """
    values = depth.values
    if depth.kind == "inverse":
        inverse = scale * values + shift
        with np.errstate(divide="ignore", invalid="ignore"):
            values, scale = np.where(inverse > 0, 1.0 / inverse, np.nan), 1.0
    if depth.kind == "ray" or unit_ray:
        column, row = np.arange(camera.width), np.arange(camera.height)[:, None]
        values = values / ray_length(camera, column, row)
    return values.astype(np.float32, copy=False), scale
