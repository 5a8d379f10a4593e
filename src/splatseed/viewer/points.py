"""Drawing points as a camera sees them, in their own colours or in those of their origins.

Notation: a picture is uint8 [H, W, 3], ``uv`` are pixels [N, 2]; an origin is a
``PointCloud.source`` code. Promise: points are drawn with a depth test, as small discs sized
relative to the picture and not to the cloud, so that a denser cloud looks denser; the same input
gives the same bytes; the same origin has the same colour in every picture, and the methods that are
mixed in one cloud have colours that the colour-blind can tell apart (Okabe and Ito).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image as PillowImage

from splatseed.camera import Camera
from splatseed.methods import SOURCE_CODES
from splatseed.pointcloud import GENERATED, ORIGINAL, PointCloud
from splatseed.runtime.jit import inline
from splatseed.viewer.page import PAPER, fitted, resized

DISCS_PER_SIDE = 340
"""A disc at the median depth is the picture's longer side divided by this: 2.4 px at 800."""
SMOOTHING = 2
"""Pictures are drawn this much larger and averaged down, so that discs are round."""
ORIGIN_POINT_SIZE = 3.0
PALE = 0.7
"""How far a photograph behind points is bleached."""
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
"""The colour of each origin; others have that of ``GENERATED``."""


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
    radii = depth
    if len(depth):  # near discs are larger, within limits
        radii = size * SMOOTHING / 2 * np.clip(np.median(depth) / depth, 0.75, 2.0)
    # The nearest point whose disc covers each pixel; -1 where there is none.
    front = np.full((SMOOTHING * height, SMOOTHING * width), -1)
    _draw_discs(uv, depth, radii, np.full(front.shape, np.inf), front)
    colors = np.concatenate([rgb, [PAPER]]).astype(np.float64)[front]
    blocks = (height, SMOOTHING, width, SMOOTHING)
    behind = np.broadcast_to(np.asarray(background, np.float64), (height, width, 3))
    covered = (front >= 0).reshape(blocks)[..., None]
    picture = np.where(covered, colors.reshape(*blocks, 3), behind[:, None, :, None])
    return np.asarray(np.round(picture.mean(axis=(1, 3))), np.uint8)


def origin_colors(source: UInt8[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """The colour of each point's origin."""
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
    """The points over the photograph, of any size, grey and pale so that their colours stand out.

    Other arguments as of ``render_points``; without a photograph it is white.
    """
    background: tuple[int, int, int] | UInt8[np.ndarray, "H W 3"] = PAPER
    if photograph is not None:
        grey = np.asarray(PillowImage.fromarray(photograph).convert("L"))
        size = fitted(camera.width, camera.height, max(camera.width, camera.height) * scale)
        shown = resized(grey, size).astype(np.float64)
        pale = np.round(PALE * 255 + (1 - PALE) * shown).astype(np.uint8)
        background = np.repeat(pale[..., None], 3, axis=2)
    return render_points(points, camera, point_size=point_size, background=background, scale=scale)


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
