"""StereoMap: depth and normals at the pixels of one photograph.

Notation: a map is H x W pixels; ``camera`` is the photograph's, scaled to the map's pixels, with
the centre of the first at (0.5, 0.5). Promise: what other views do not confirm is NaN, and its
confidence 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.camera import Camera


@dataclass(frozen=True, eq=False)
class StereoMap:
    """Depth, normal and confidence of one view.

    Args:
        name: The image's name.
        camera: Pinhole, in pixels of the map.
        depth: Planar z, scene units, float32 [H, W]; NaN where unknown.
        normal: Unit vectors in camera axes, towards the camera, float32 [H, W, 3]; NaN where
            unknown.
        confidence: From 0, unknown, to 1, float32 [H, W].
        sources: Names of the views it was compared with, best first; 8 at most.
        agreeing: Bit k is set where source k confirms the depth, uint8 [H, W].
    """

    name: str
    camera: Camera
    depth: Float32[np.ndarray, "H W"]
    normal: Float32[np.ndarray, "H W 3"]
    confidence: Float32[np.ndarray, "H W"]
    sources: tuple[str, ...]
    agreeing: UInt8[np.ndarray, "H W"]

    @property
    def known_share(self) -> float:
        """The fraction of pixels that have a depth."""
        return float(np.isfinite(self.depth).mean())
