"""Removal of lens distortion from photographs.

Promise: colours are interpolated between four pixels and rounded; pixels that the photograph does
not show, or shows a second time beyond a fold of the lens, are black and marked as unknown.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatseed.camera import Intrinsics
from splatseed.frozen import read_only_view
from splatseed.lens import distort, fold_radius
from splatseed.photos._kernels import resample
from splatseed.projection import denormalized, normalized, pixel_centers

BAND = 64  # rows of a photograph computed at a time, which bounds the memory of their rays


def undistort(
    photograph: UInt8[np.ndarray, "H W 3"], lens: Intrinsics, K: Float64[np.ndarray, "3 3"]
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """Resample a photograph as a pinhole camera with matrix K takes it; and which pixels it knows.

    ``lens`` is the photograph's camera; K is in its pixels.
    """
    height, width = photograph.shape[:2]
    out, known = np.zeros_like(photograph), np.zeros((height, width), np.bool_)
    corners = normalized(K, np.array([(0, 0), (width, 0), (0, height), (width, height)]))
    limit = fold_radius(lens, float(np.linalg.norm(corners, axis=-1).max()))
    for first in range(0, height, BAND):
        rows = slice(first, min(first + BAND, height))
        rays = normalized(K, pixel_centers(rows.stop - first, width) + np.array([0, first]))
        with np.errstate(all="ignore"):  # beyond the fold nothing needs to be finite
            uv = denormalized(K, distort(lens, rays))
        # Beyond the fold the lens maps two rays to one pixel.
        uv[np.linalg.norm(rays, axis=-1) > limit] = np.nan
        resample(read_only_view(photograph), uv, out[rows], known[rows])
    return out, known
