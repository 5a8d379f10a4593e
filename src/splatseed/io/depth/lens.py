"""Depth maps of a distorted lens, resampled to the pixels of undistorted photographs.

Notation: ``lens`` is the camera that took the maps, in one of COLMAP's models; the photographs were
undistorted to pinhole cameras at the same place. Promise: planar depth belongs to the ray and not
to the pixel, so values are moved, never changed; a pixel takes the nearest value, so that no depth
between two surfaces is invented, and NaN where the lens did not look.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from splatseed.camera import Intrinsics
from splatseed.lens import image_points


@dataclass(frozen=True, eq=False)
class Undistortion:
    """Moves the values of a map to where undistorted photographs have them.

    Args:
        lens: The camera of the maps.
        cameras: The pinhole camera of each photograph, by its name.
    """

    lens: Intrinsics
    cameras: Mapping[str, Intrinsics]

    def apply(self, name: str, values: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "h w"]:
        """The map in the pixels of one photograph, at that photograph's size.

        Args:
            name: The photograph.
            values: A map that was taken with the lens, of its size or a resized copy.
        """
        camera = self.cameras[name]
        height, width = values.shape
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
        uv = image_points(self.lens, np.stack([(column - cx) / fx, (row - cy) / fy], axis=-1))
        uv *= [width / self.lens.width, height / self.lens.height]
        inside = np.all((uv >= 0) & (uv < [width, height]), axis=-1)
        column, row = (
            np.floor(np.where(inside[..., None], uv, 0)).astype(np.intp).transpose(2, 0, 1)
        )
        return np.where(inside, values[row, column], np.float32(np.nan))
