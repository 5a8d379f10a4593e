"""Removal of lens distortion from photographs.

Promise: colours are interpolated between four pixels and rounded; pixels that the photograph does
not show, or shows a second time beyond a fold of the lens, are black and marked as unknown.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatseed.camera import Intrinsics
from splatseed.lens import distort, fold_radius
from splatseed.photos._kernels import resample

BAND = 64  # rows of a photograph computed at a time, which bounds the memory of their rays


def undistort(
    photograph: UInt8[np.ndarray, "H W 3"], lens: Intrinsics, K: Float64[np.ndarray, "3 3"]
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """Resample a photograph as a pinhole camera with matrix K takes it; and which pixels it knows.

    ``lens`` is the photograph's camera; K is in its pixels.
    """
    height, width = photograph.shape[:2]
    out, known = np.zeros_like(photograph), np.zeros((height, width), np.bool_)
    corners = _rays(K, np.array([0.0, width]), np.array([0.0, height]))
    limit = fold_radius(lens, float(np.linalg.norm(corners, axis=-1).max()))
    column = np.arange(width) + 0.5
    for first in range(0, height, BAND):
        rows = slice(first, min(first + BAND, height))
        rays = _rays(K, column, np.arange(rows.start, rows.stop) + 0.5)
        with np.errstate(all="ignore"):  # beyond the fold nothing needs to be finite
            uv = distort(lens, rays) * K[[0, 1], [0, 1]] + K[:2, 2]
        # Beyond the fold the lens maps two rays to one pixel.
        uv[np.linalg.norm(rays, axis=-1) > limit] = np.nan
        resample(photograph, uv, out[rows], known[rows])
    return out, known


def _rays(
    K: Float64[np.ndarray, "3 3"], column: Float64[np.ndarray, " W"], row: Float64[np.ndarray, " H"]
) -> Float64[np.ndarray, "H W 2"]:
    """(x, y) of the rays (x, y, 1) = K^-1 (column, row, 1) through a grid of pixels."""
    x, y = np.meshgrid((column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1])
    return np.stack([x, y], axis=-1)
