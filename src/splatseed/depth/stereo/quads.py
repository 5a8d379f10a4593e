"""Photographs as stereo's kernels read them: quad images and projections between views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

from splatseed.depth.stereo._kernels.cost import pack_quads, to_grey
from splatseed.depth.stereo._kernels.patchmatch import QuadImages
from splatseed.photos.view import View

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue, ITU-R BT.601."""

Grey = UInt8[np.ndarray, "H W"]


def grey_image(image: UInt8[np.ndarray, "H W 3"]) -> Grey:
    """Luma of sRGB pixels, rounded to 8 bits."""
    out = np.empty(image.shape[:2], np.uint8)
    to_grey(image, LUMA, out)
    return out


def make_quads(grey: Grey) -> Int32[np.ndarray, "H W"]:
    """Quad image of a grey image (see ``_kernels.cost``)."""
    out = np.empty(grey.shape, np.int32)
    pack_quads(grey, out)
    return out


def make_quad_images(
    view: View,
    grey: Grey,
    others: Sequence[View],
    greys: Sequence[Grey],
    grid: int,
    bounds: Float32[np.ndarray, " 2"],
) -> QuadImages:
    """Pack a view and its sources for the kernels.

    Args:
        view: The reference view.
        grey: Its grey image.
        others: Its sources.
        greys: Their grey images.
        grid: Pixels between grid points.
        bounds: Smallest and largest inverse depth.
    """
    offsets = np.cumsum([0, *(image.size for image in greys)])
    sources: Int32[np.ndarray, " Q"] = np.empty(offsets[-1], np.int32)
    for start, stop, image in zip(offsets, offsets[1:], greys, strict=False):
        sources[start:stop] = make_quads(image).ravel()
    warps = [other_from_view(view, other) for other in others]
    packed = [np.concatenate([warp[:, :3].ravel(), warp[:, 3]]) for warp in warps]
    sizes = np.array([(other.width, other.height) for other in others], np.int64)
    return QuadImages(
        make_quads(grey).ravel(), np.array([view.width, view.height], np.int64),
        sources, sizes, offsets, np.array(packed, np.float32), grid, float(view.K[0, 0]), bounds,
    )  # fmt: skip


def other_from_view(view: View, other: View) -> Float64[np.ndarray, "3 4"]:
    """Matrix K_s [R K_r^-1, t] from pixels (u, v, 1) of a view times depth, and 1, to another's."""
    # source from reference: x_s = R x_r + t with x_r = z K_r^-1 (u, v, 1)
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    return np.asarray(
        other.K @ np.hstack([relative[:3, :3] @ np.linalg.inv(view.K), relative[:3, 3:]])
    )
