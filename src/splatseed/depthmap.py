"""DepthMap: the distance of each pixel of an image, and the source of such maps.

Notation: a map is H x W pixels and belongs to one image, of the same size or at least the same
aspect ratio: its pixel (column u, row v) has its centre at ((u + 0.5) / W, (v + 0.5) / H) of the
image's width and height. Promise: values are float32, NaN where unknown; a ``DepthMaps`` reads each
map on demand, so a scene's maps need not fit in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.camera import Camera
from splatseed.errors import SceneFormatError

DepthKind = Literal["z", "ray", "inverse"]
"""What a value is: planar depth z along the camera's axis, distance along the pixel's ray, or an
inverse depth of the form a / z + b (what most monocular networks predict)."""

ASPECT_SLACK = 0.02
"""By how much a map's aspect ratio may differ from its image's: the rounding of a resized copy."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth that one image sees.

    Values are NaN where unknown. Of the kinds "z" and "ray" they are positive, in scene units or in
    a multiple of them that alignment determines.
    """

    values: Float32[np.ndarray, "H W"]
    kind: DepthKind = "z"  # what a value is

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return int(self.values.shape[1])

    @property
    def height(self) -> int:
        """Pixels in a column."""
        return int(self.values.shape[0])

    def camera(self, camera: Camera) -> Camera:
        """The image's camera scaled to the map's pixels: same pose, K scaled.

        Raises:
            SceneFormatError: The map and the image differ in aspect ratio.
        """
        scale = np.array([self.width / camera.width, self.height / camera.height])
        if abs(scale[0] / scale[1] - 1) > ASPECT_SLACK:
            raise SceneFormatError(
                f"a depth map with the aspect ratio of its image, {camera.width} x {camera.height}",
                found=f"{self.width} x {self.height}",
                fix="Make depth from the images of this scene, or resize both alike.",
            )
        K: Float64[np.ndarray, "3 3"] = np.diag([*scale, 1.0]) @ camera.K
        return Camera(K, self.width, self.height, camera.cam_from_world)


class DepthMaps(Protocol):
    """The depth maps of a scene, by image name."""

    def __contains__(self, name: object) -> bool:
        """Whether the image of that name has a map."""

    def __iter__(self) -> Iterator[str]:
        """The names of the images that have a map."""

    def __len__(self) -> int:
        """How many images have a map."""

    def read(self, name: str) -> DepthMap:
        """The map of an image; safe to call from several threads.

        Raises:
            SceneNotFoundError: The image has none, or its file is gone.
            SceneFormatError: The file is not what its format promises.
        """
