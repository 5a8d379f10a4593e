"""Where points lie in views, which views see the same, and photographs without distortion.

Notation: ``matrix`` [3, 4] maps homogeneous world points to (column z, row z, z). With K @
``cam_from_world[:3]`` columns and rows are pixel coordinates, the centre of the first at (0.5,
0.5); a coarser grid, or one whose points lie at whole numbers, has its own first matrix instead of
K. There are V views and P points; the *worth* of a pair of views is the sum, over the points that
both see, of a weight by the angle between their two rays.
Promise: places are computed in float64 in the order written, whatever the type of the point; pairs
depend on poses and visibility only, not on threads or the order of points; of a distorted
photograph colours are interpolated between four pixels and rounded, and pixels that it does not
show, or shows a second time beyond a fold, are black and marked as unknown.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from splatseed.camera import Intrinsics
from splatseed.lens import distort, fold_radius
from splatseed.runtime.jit import always_inline, inline, kernel, parallel_range


@inline
def place(point, matrix):  # type: ignore[no-untyped-def]  # Numba's types
    """Column, row and planar depth of a world point [3], as floats.

    The point is behind the camera if the depth is negative; at 0 column and row are not finite.
    """
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    # (column z, row z, z) = matrix (x, y, z, 1)
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    inverse = 1.0 / depth
    column = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) * inverse
    row = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) * inverse
    return column, row, depth


@always_inline
def cosine_between(point, first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """Cosine of the angle at a point [3] between rays to cameras at ``first`` and ``second``."""
    dot, first_squared, second_squared = 0.0, 0.0, 0.0
    for axis in range(3):
        a, b = point[axis] - first[axis], point[axis] - second[axis]
        dot += a * b
        first_squared += a * a
        second_squared += b * b
    return dot / np.sqrt(first_squared * second_squared)


LEAST, FULL, WIDE, MOST = 1.0, 4.0, 15.0, 45.0
"""Degrees between which the weight rises, stays full, and falls."""
ALIKE = 30.0  # largest angle in degrees between the axes of cameras that look the same way
SAME_PLACE = 1e-6  # share of the usual distance within which two cameras count as coincident
ROUNDING = 1e-12  # share of the largest distance that is rounding
MOST_POINTS = 4000  # points tested per view: more do not change the order of its pairs


def choose_sources(
    seen: Sequence[Int64[np.ndarray, " M"]],
    xyz: Float64[np.ndarray, "P 3"],
    centers: Float64[np.ndarray, "V 3"],
    num: int,
) -> Int64[np.ndarray, "V num"]:
    """The ``num`` views to compare each view with, best first; -1 for none.

    ``seen`` are the points that each view sees, as rows of ``xyz``.
    """
    count = len(seen)
    worth = np.zeros((count, count))
    if count > 1 and len(xyz):
        order, offsets = views_of_points(seen, len(xyz))
        asked = [each[:: -(-len(each) // MOST_POINTS) or 1] for each in seen]
        starts = np.cumsum([0, *map(len, asked)])
        rows = np.concatenate(asked)
        _add_up(rows, starts, xyz, centers, order, offsets, worth)
    best = np.argsort(-worth, axis=1, kind="stable")[:, :num]
    chosen = np.full((count, num), -1)
    chosen[:, : best.shape[1]] = np.where(np.take_along_axis(worth, best, 1) > 0, best, -1)
    return chosen


def choose_by_pose(
    cam_from_world: Float64[np.ndarray, "V 4 4"], num: int
) -> Int64[np.ndarray, "V num"]:
    """The same from poses alone: nearby views that look the same way.

    The very nearest are skipped if there are enough others: their parallax is too small.
    """
    centers = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
    gap = np.linalg.norm(centers[:, None] - centers, axis=2)
    # The third row of a rotation is the camera's axis in the world.
    cosine = cam_from_world[:, 2, :3] @ cam_from_world[:, 2, :3].T
    chosen = np.full((len(centers), num), -1)
    for i in range(len(centers)):
        apart = gap[i][gap[i] > ROUNDING * gap.max()]
        # By the median, so that one camera far away does not make all others coincide.
        other = np.flatnonzero(gap[i] > SAME_PLACE * (np.median(apart) if len(apart) else np.inf))
        alike = other[cosine[i, other] > np.cos(np.radians(ALIKE))]
        if len(alike) < num:
            alike = other[np.argsort(-cosine[i, other], kind="stable")[:num]]
        near = alike[np.argsort(gap[i, alike], kind="stable")]
        # The nearest num / 2 are skipped, as far as the others suffice.
        near = near[min(num // 2, len(near) - min(num, len(near))) :][:num]
        chosen[i, : len(near)] = near
    return chosen


def views_of_points(
    seen: Sequence[Int64[np.ndarray, " M"]], num_points: int
) -> tuple[Int64[np.ndarray, " T"], Int64[np.ndarray, " P+1"]]:
    """The views of each point, and where each point's begin; ``seen`` as in ``choose_sources``."""
    view = np.repeat(np.arange(len(seen)), [len(each) for each in seen])
    point = np.concatenate(seen)
    offsets = np.zeros(num_points + 1, np.int64)
    np.cumsum(np.bincount(point, minlength=num_points), out=offsets[1:])
    return view[np.argsort(point, kind="stable")], offsets


@kernel
def _add_up(rows, starts, xyz, centers, order, offsets, worth):  # type: ignore[no-untyped-def]  # Numba's types
    """The worth of all pairs."""
    for i in parallel_range(len(centers)):
        for k in range(starts[i], starts[i + 1]):
            point = rows[k]
            for t in range(offsets[point], offsets[point + 1]):
                j = order[t]
                if j != i:
                    worth[i, j] += _weight(xyz[point], centers[i], centers[j])


@inline
def _weight(point, first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """The weight of a point by the angle between its rays to two cameras."""
    cosine = cosine_between(point, first, second)
    angle = np.degrees(np.arccos(min(max(cosine, -1.0), 1.0)))
    # Where the rays nearly coincide, depth hardly moves a point in the photographs.
    rising = min(max((angle - LEAST) / (FULL - LEAST), 0.0), 1.0)
    # Beyond WIDE degrees a surface looks different.
    falling = min(max((MOST - angle) / (MOST - WIDE), 0.0), 1.0)
    return rising * falling


ROWS = 64  # rows of a photograph computed at a time, which bounds the memory of their rays


def undistort(
    photograph: UInt8[np.ndarray, "H W 3"], lens: Intrinsics, K: Float64[np.ndarray, "3 3"]
) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The photograph as a pinhole camera would have taken it, and which of its pixels are known.

    ``lens`` is its camera, K that camera's matrix in pixels of the photograph and of the result.
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
    """Where the rays K^-1 (column, row, 1) of a grid of pixels meet the plane at depth 1."""
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
