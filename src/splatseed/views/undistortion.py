"""Photographs of a distorted lens as a pinhole camera would have taken them.

Notation: the pinhole camera has the lens's own focal length, centre and size. The pixel (i, j) of
its image looks along the ray K^-1 (j + 0.5, i + 0.5, 1), which the lens maps to a position in the
photograph.
Promise: colours are interpolated between the four pixels around that position and rounded; pixels
that the photograph does not show, or shows a second time beyond a fold, are black and marked as
unknown.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatseed.camera import Intrinsics
from splatseed.lens import distort, fold_radius
from splatseed.runtime.jit import inline

ROWS = 64
"""Rows computed at a time, which bounds the memory of their rays."""


def undistort(
    photograph: UInt8[np.ndarray, "H W 3"], lens: Intrinsics, K: Float64[np.ndarray, "3 3"]
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The photograph without distortion, and which of its pixels are known.

    Args:
        photograph: The photograph, of any size.
        lens: Its camera, for the distortion.
        K: The camera's matrix in pixels of ``photograph``, also valid for the result.
    """
    height, width = photograph.shape[:2]
    out, known = np.zeros_like(photograph), np.zeros((height, width), np.bool_)
    corners = _rays(K, np.array([0.0, width]), np.array([0.0, height]))
    limit = fold_radius(lens, float(np.linalg.norm(corners, axis=-1).max()))
    column = np.arange(width) + 0.5
    for first in range(0, height, ROWS):
        rows = slice(first, min(first + ROWS, height))
        rays = _rays(K, column, np.arange(rows.start, rows.stop) + 0.5)
        with np.errstate(all="ignore"):  # beyond the fold nothing needs to be finite
            uv = distort(lens, rays) * K[[0, 1], [0, 1]] + K[:2, 2]
        # Beyond the fold the lens maps two rays to one pixel.
        uv[np.linalg.norm(rays, axis=-1) > limit] = np.nan
        _resample(photograph, uv, out[rows], known[rows])
    return out, known


def _rays(
    K: Float64[np.ndarray, "3 3"], column: Float64[np.ndarray, " W"], row: Float64[np.ndarray, " H"]
) -> Float64[np.ndarray, "H W 2"]:
    """Where the rays of a grid of pixel coordinates meet the plane at depth 1."""
    x, y = np.meshgrid((column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1])
    return np.stack([x, y], axis=-1)


@inline
def _resample(photograph, uv, out, known):  # type: ignore[no-untyped-def]  # Numba's types
    """Bilinear colours at positions, NaN = outside; edge pixels extend to the border."""
    height, width = photograph.shape[:2]
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            u, v = uv[i, j, 0], uv[i, j, 1]
            if not (0.0 <= u <= width and 0.0 <= v <= height):
                continue
            known[i, j] = True
            x = min(max(u - 0.5, 0.0), width - 1.0)  # pixel centres at whole numbers
            y = min(max(v - 0.5, 0.0), height - 1.0)
            left, top = int(x), int(y)
            right, below = min(left + 1, width - 1), min(top + 1, height - 1)
            a, b = x - left, y - top
            for channel in range(3):
                upper = (1 - a) * photograph[top, left, channel] + a * photograph[
                    top, right, channel
                ]
                lower = (1 - a) * photograph[below, left, channel] + a * photograph[
                    below, right, channel
                ]
                out[i, j, channel] = int((1 - b) * upper + b * lower + 0.5)
