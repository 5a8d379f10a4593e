"""StereoMap: what stereo found out about one photograph.

Notation: a map is H x W pixels with a pinhole camera of its own, the centre of the first pixel at
(0.5, 0.5). Promise: arrays agree in size with each other and with the camera; a pixel that no other
view confirms has NaN depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.camera import Camera

__all__ = ["StereoMap"]


@dataclass(frozen=True, eq=False)
class StereoMap:
    """Depth, normal and confidence of the pixels of one image.

    Args:
        name: Of the image.
        camera: In pixels of this map.
        depth: Planar z-depth in scene units, float32 [H, W]; NaN where unknown or not confirmed.
        normal: Unit normals in camera axes, facing the camera (normal . ray < 0), float32
            [H, W, 3]; NaN where unknown.
        confidence: 0 to 1, float32 [H, W]; 0 where depth is NaN.
        sources: Names of the views it was compared with, best first, 8 at most.
        agreeing: uint8 [H, W]; bit k is set where source k confirms the pixel.
    """

    name: str
    camera: Camera
    depth: Float32[np.ndarray, "H W"]
    normal: Float32[np.ndarray, "H W 3"]
    confidence: Float32[np.ndarray, "H W"]
    sources: tuple[str, ...]
    agreeing: UInt8[np.ndarray, "H W"]
