"""Depth maps in the pixels and the measure of a camera.

Notation: a ray has unit z in camera axes, so that its length is distance over planar depth. Promise:
a pixel's ray passes through its centre, at +0.5.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.depthmap import DepthMap
from splatseed.errors import SceneFormatError
from splatseed.scene import Image

__all__ = ["map_camera", "ray_length"]


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


def ray_length(camera: Camera, column: np.ndarray, row: np.ndarray) -> Float64[np.ndarray, " M"]:
    """Distance over planar depth along the rays through pixels' centres, [M]."""
    pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))])
    return np.asarray(np.linalg.norm(np.linalg.inv(camera.K) @ pixel, axis=0))
