"""DepthMap: how far away each pixel of an image is, and where such maps come from.

Notation: a map is H x W pixels and belongs to one image, of the same size or another of the same
shape: its pixel (column u, row v) has its centre at ((u + 0.5) / W, (v + 0.5) / H) of the image's
width and height. Promise: values are float32 with NaN wherever nothing is known; a ``DepthMaps``
reads a map when it is asked for, so that a scene's maps need not fit the memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.camera import Camera
from splatseed.errors import SceneFormatError

__all__ = ["ASPECT_SLACK", "DepthKind", "DepthMap", "DepthMaps"]

DepthKind = Literal["z", "ray", "inverse"]
"""What a value is: planar depth along the camera's axis, distance along the pixel's ray, or
something that falls with z as a / z + b does (what most monocular networks predict)."""

ASPECT_SLACK = 0.02
"""By how much a map's shape may differ from its image's: the rounding of a resized copy."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """What one image sees, in depth.

    Args:
        values: float32 [H, W]; NaN where nothing is known. For the kinds "z" and "ray" positive, in
            units that are the scene's or (to be found by alignment) a multiple of them.
        kind: What a value is.
    """

    values: Float32[np.ndarray, "H W"]
    kind: DepthKind = "z"

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return int(self.values.shape[1])

    @property
    def height(self) -> int:
        """Pixels in a column."""
        return int(self.values.shape[0])

    def camera(self, camera: Camera) -> Camera:
        """The camera of the image with its pixels those of the map: same pose, K scaled.

        Raises:
            SceneFormatError: The map has not the shape of the image.
        """
        scale = np.array([self.width / camera.width, self.height / camera.height])
        if abs(scale[0] / scale[1] - 1) > ASPECT_SLACK:
            raise SceneFormatError(
                f"a depth map of the shape of its image, {camera.width} x {camera.height}",
                found=f"{self.width} x {self.height}",
                fix="Make depth from the images of this scene, or resize both alike.",
            )
        K: Float64[np.ndarray, "3 3"] = np.diag([*scale, 1.0]) @ camera.K
        return Camera(K, self.width, self.height, camera.cam_from_world)


class DepthMaps(Protocol):
    """The depth maps of a scene, by the names of its images."""

    def __contains__(self, name: object) -> bool:
        """Whether there is a map for the image of that name."""
        ...

    def __iter__(self) -> Iterator[str]:
        """The names of the images that have a map."""
        ...

    def __len__(self) -> int:
        """How many images have a map."""
        ...

    def read(self, name: str) -> DepthMap:
        """The map of an image; safe to call from several threads.

        Raises:
            SceneNotFoundError: The image has none, or its file is gone.
            SceneFormatError: The file is not what its format promises.
        """
        ...
