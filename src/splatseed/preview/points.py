"""Drawing points as a camera sees them.

Notation: a picture is uint8 [H, W, 3], ``uv`` are pixels [N, 2]. Promise: points are drawn with a
depth test, as small discs sized relative to the picture and not to the cloud, so that a denser
cloud looks denser; the same input gives the same bytes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatseed.camera import Camera
from splatseed.kernels.jit import inline
from splatseed.pointcloud import PointCloud
from splatseed.preview.page import PAPER

DISCS_PER_SIDE = 340
"""A disc at the median depth is the picture's longer side divided by this: 2.4 px at 800."""

SMOOTHING = 2
"""Pictures are drawn this much larger and averaged down, so that discs are round."""


def render_points(
    points: PointCloud,
    camera: Camera,
    *,
    point_size: float | None = None,
    background: tuple[int, int, int] | UInt8[np.ndarray, "H W 3"] = PAPER,
    scale: float = 1.0,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a cloud: every pixel shows the nearest point whose disc covers it.

    Points behind the camera, outside the image or not finite are left out. A point at half the
    median depth is drawn up to twice as large.

    Args:
        points: The cloud, world coordinates.
        camera: The camera to look from; its lens distortion is ignored.
        point_size: Diameter of a disc at the median depth, in pixels of the picture; chosen from
            the picture's size when left out.
        background: Colour where there are no points, 0..255, or a picture of the same size to draw
            on.
        scale: Size of the picture relative to the camera's.

    Returns:
        The picture, uint8 [round(scale * height), round(scale * width), 3].

    Example:
        >>> import numpy as np
        >>> K = np.array([[50.0, 0, 16], [0, 50.0, 12], [0, 0, 1]])
        >>> cloud = PointCloud(np.array([[0.0, 0, 2]]), np.array([[255, 0, 0]], np.uint8))
        >>> picture = render_points(cloud, Camera(K, 32, 24, np.eye(4)), point_size=3)
        >>> picture[12, 16].tolist(), picture[0, 0].tolist()
        ([255, 0, 0], [255, 255, 255])
    """
    width, height = (max(round(side * scale), 1) for side in (camera.width, camera.height))
    size = max(width, height) / DISCS_PER_SIDE if point_size is None else point_size
    uv, depth = camera.project(points.xyz[points.finite])
    rgb = points.rgb[points.finite]
    uv = uv * (SMOOTHING * np.array([width / camera.width, height / camera.height]))
    large = np.array([width, height]) * SMOOTHING
    margin = 2 * size * SMOOTHING
    # NaN pixels of points behind the camera compare false.
    # A disc just outside the picture still reaches in.
    drawn = ((uv > -margin) & (uv < large + margin)).all(axis=1)
    uv, depth, rgb = uv[drawn], depth[drawn], rgb[drawn]
    front = _front_points(uv, depth, _radii(depth, size * SMOOTHING), large)
    colors = np.concatenate([rgb, [PAPER]]).astype(np.float64)[front]
    blocks = (height, SMOOTHING, width, SMOOTHING)
    behind = np.broadcast_to(np.asarray(background, np.float64), (height, width, 3))[
        :, None, :, None
    ]
    picture = np.where((front >= 0).reshape(blocks)[..., None], colors.reshape(*blocks, 3), behind)
    return np.asarray(np.round(picture.mean(axis=(1, 3))), np.uint8)


def _radii(depth: Float64[np.ndarray, " N"], size: float) -> Float64[np.ndarray, " N"]:
    """Radius of each disc in pixels: near ones larger, within limits."""
    if len(depth) == 0:
        return depth
    return np.asarray(size / 2 * np.clip(np.median(depth) / depth, 0.75, 2.0))


def _front_points(
    uv: Float64[np.ndarray, "N 2"],
    depth: Float64[np.ndarray, " N"],
    radii: Float64[np.ndarray, " N"],
    size: Int64[np.ndarray, " 2"],
) -> Int64[np.ndarray, "H W"]:
    """Index of the nearest point whose disc covers each pixel, [H, W]; -1 where there is none."""
    width, height = (int(side) for side in size)
    front = np.full((height, width), -1)
    _draw_discs(uv, depth, radii, np.full((height, width), np.inf), front)
    return front


@inline
def _draw_discs(uv, depth, radii, nearest, front):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202  (a Numba kernel)
    """Draw every disc into the depth buffer ``nearest``; at equal depth the first point stays."""
    height, width = front.shape
    for i in range(len(depth)):
        u, v, r = uv[i, 0], uv[i, 1], radii[i]
        column, row = int(np.floor(u)), int(np.floor(v))
        for y in range(max(int(v - r), 0), min(int(v + r) + 1, height)):
            for x in range(max(int(u - r), 0), min(int(u + r) + 1, width)):
                covered = (x + 0.5 - u) ** 2 + (y + 0.5 - v) ** 2 <= r * r
                own = x == column and y == row  # however small, a point is visible
                if (covered or own) and depth[i] < nearest[y, x]:
                    nearest[y, x] = depth[i]
                    front[y, x] = i
