"""Draw points as a camera sees them, in their own colours or by origin.

Notation: a picture is uint8 [H, W, 3], ``uv`` are pixels [N, 2]; an origin is a
``PointCloud.source`` code. Promise: points are drawn with a depth test, as small discs sized
relative to the picture, so that a denser cloud looks denser; the same input gives the same bytes;
an origin has the same colour in every picture, and methods mixed in one cloud have colours that are
safe for colour-blind readers (Okabe and Ito).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image as PillowImage

from splatseed.camera import Camera
from splatseed.methods import SOURCE_CODES
from splatseed.pointcloud import GENERATED, ORIGINAL, PointCloud
from splatseed.viewer._kernels import draw_discs
from splatseed.viewer.page import GROUND, PAPER, fitted, resized

DISCS_PER_SIDE = 340
"""A disc at the median depth is the picture's longer side divided by this: 2.4 px at 800."""
SMOOTHING = 2
"""Supersampling per axis, so that discs are round."""
ORIGIN_POINT_SIZE = 3.0  # pixels
PALE = 0.7
"""Weight of white in a photograph behind points."""
COLORS: dict[int, tuple[int, int, int]] = {
    ORIGINAL: (0, 0, 0),
    SOURCE_CODES["linear"]: (230, 159, 0),
    SOURCE_CODES["triangle"]: (190, 170, 0),
    SOURCE_CODES["spline"]: (204, 121, 167),
    SOURCE_CODES["mls"]: (0, 158, 115),
    SOURCE_CODES["voronoi"]: (118, 42, 131),
    SOURCE_CODES["depth"]: (86, 180, 233),
    SOURCE_CODES["random"]: (128, 128, 128),
    SOURCE_CODES["stereo"]: (0, 114, 178),
    SOURCE_CODES["cover"]: (213, 94, 0),
    SOURCE_CODES["cloud"]: (240, 228, 66),
    GENERATED: (140, 86, 75),
}
"""Colour of each origin; other origins get that of ``GENERATED``."""


def render_points(
    points: PointCloud,
    camera: Camera,
    *,
    point_size: float | None = None,
    background: tuple[int, int, int] | UInt8[np.ndarray, "H W 3"] = GROUND,
    scale: float = 1.0,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a cloud: each pixel shows the nearest point whose disc covers it.

    Points behind the camera, outside the image or not finite are left out. Nearer points are drawn
    larger, up to twice the size at the median depth.

    Args:
        points: The cloud, world coordinates.
        camera: The camera to look from; its lens distortion is ignored.
        point_size: Diameter of a disc at the median depth, in pixels of the picture; by
            default a 340th of the picture's longer side.
        background: Colour where there are no points, 0..255, by default mid-grey, or a picture of
            the same size.
        scale: Size of the picture relative to the camera's.

    Returns:
        The picture, uint8 [round(scale * height), round(scale * width), 3].

    Example:
        >>> import numpy as np
        >>> K = np.array([[50.0, 0, 16], [0, 50.0, 12], [0, 0, 1]])
        >>> cloud = PointCloud(np.array([[0.0, 0, 2]]), np.array([[255, 0, 0]], np.uint8))
        >>> picture = render_points(cloud, Camera(K, 32, 24, np.eye(4)), point_size=3)
        >>> picture[12, 16].tolist(), picture[0, 0].tolist()
        ([255, 0, 0], [110, 110, 110])
    """
    width, height = (max(round(side * scale), 1) for side in (camera.width, camera.height))
    size = max(width, height) / DISCS_PER_SIDE if point_size is None else point_size
    uv, depth = camera.project(points.xyz[points.finite])
    rgb = points.rgb[points.finite]
    uv = uv * (SMOOTHING * np.array([width / camera.width, height / camera.height]))
    large = np.array([width, height]) * SMOOTHING
    margin = 2 * size * SMOOTHING
    # A disc just outside the picture reaches in. NaN, behind the camera, compares false.
    drawn = ((uv > -margin) & (uv < large + margin)).all(axis=1)
    uv, depth, rgb = uv[drawn], depth[drawn], rgb[drawn]
    radii = depth
    if len(depth):  # near discs are larger, within limits
        radii = size * SMOOTHING / 2 * np.clip(np.median(depth) / depth, 0.75, 2.0)
    # The nearest point whose disc covers each pixel; -1 where there is none.
    front = np.full((SMOOTHING * height, SMOOTHING * width), -1)
    draw_discs(uv, depth, radii, np.full(front.shape, np.inf), front)
    colors = np.concatenate([rgb, [PAPER]]).astype(np.uint16)
    behind = np.broadcast_to(np.asarray(background, np.uint16), (height, width, 3))
    total = np.zeros((height, width, 3), np.uint16)
    for row, column in np.ndindex(SMOOTHING, SMOOTHING):
        shown = front[row::SMOOTHING, column::SMOOTHING]
        total += np.where((shown >= 0)[..., None], colors[shown], behind)
    return np.asarray(np.round(total / SMOOTHING**2), np.uint8)


def origin_colors(source: UInt8[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """Colour of each point's origin."""
    table = np.tile(np.array(COLORS[GENERATED], np.uint8), (256, 1))
    for code, color in COLORS.items():
        table[code] = color
    return np.asarray(table[source])


def points_over(
    points: PointCloud,
    camera: Camera,
    photograph: UInt8[np.ndarray, "h w 3"] | None = None,
    *,
    point_size: float = ORIGIN_POINT_SIZE,
    scale: float = 1.0,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw points over a pale grey photograph of any size; without one, on white.

    Other arguments as for ``render_points``.
    """
    background: tuple[int, int, int] | UInt8[np.ndarray, "H W 3"] = PAPER
    if photograph is not None:
        grey = np.asarray(PillowImage.fromarray(photograph).convert("L"))
        size = fitted(camera.width, camera.height, max(camera.width, camera.height) * scale)
        shown = resized(grey, size).astype(np.float64)
        pale = np.round(PALE * 255 + (1 - PALE) * shown).astype(np.uint8)
        background = np.repeat(pale[..., None], 3, axis=2)
    return render_points(points, camera, point_size=point_size, background=background, scale=scale)
