"""Pictures of point clouds, as seen by one of the scene's own cameras.

Notation: a picture is uint8 [H, W, 3]; a tile is a picture with its label. Promise: points are drawn
with a depth test, as small discs whose size belongs to the picture and not to the cloud, so that a
denser cloud looks denser; the same input gives the same bytes; files appear whole or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from PIL import Image as PillowImage, ImageDraw, ImageFont

from splatseed.camera import Camera
from splatseed.errors import PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.io.staging import atomic_file
from splatseed.jit import inline
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.viewpoint import choose_camera, choose_image

__all__ = [
    "Tile",
    "choose_camera",
    "color_bar",
    "heat",
    "preview_errors",
    "preview_methods",
    "preview_pair",
    "render_points",
    "write_grid",
]

PAIR_SIDE = 800
GRID_SIDE = 600
"""Pictures are scaled so that their longer side has this many pixels."""

DISCS_PER_SIDE = 340
"""A disc at the median depth is the picture's longer side divided by this: 2.4 px at 800."""

SMOOTHING = 2
"""Pictures are drawn this much larger and averaged down, so that discs are round."""

PAPER = (255, 255, 255)
INK = (20, 20, 20)


class Tile(NamedTuple):
    """A picture and the words above it."""

    label: str
    picture: UInt8[np.ndarray, "H W 3"]


def render_points(
    points: PointCloud,
    camera: Camera,
    *,
    point_size: float | None = None,
    background: tuple[int, int, int] = PAPER,
    scale: float = 1.0,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a cloud: every pixel shows the nearest point whose disc covers it.

    Points behind the camera, outside the image or not finite are left out. A point at half the
    median depth is drawn up to twice as large.

    Args:
        points: The cloud, world coordinates.
        camera: From where; its lens distortion is not drawn.
        point_size: Diameter of a disc at the median depth, in pixels of the picture; chosen from
            the picture's size when left out.
        background: Colour where there are no points, 0..255.
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
    drawn = ((uv > -margin) & (uv < large + margin)).all(axis=1)
    uv, depth, rgb = uv[drawn], depth[drawn], rgb[drawn]
    front = _front_points(uv, depth, _radii(depth, size * SMOOTHING), large)
    picture = np.concatenate([rgb, [background]]).astype(np.float64)[front]
    blocks = picture.reshape(height, SMOOTHING, width, SMOOTHING, 3)
    return np.asarray(np.round(blocks.mean(axis=(1, 3))), np.uint8)


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
                own = x == column and y == row  # however small, a point is seen
                if (covered or own) and depth[i] < nearest[y, x]:
                    nearest[y, x] = depth[i]
                    front[y, x] = i


def preview_pair(
    scene: Scene, upsampled: PointCloud, path: Path | str, *, title: str = "upsampled"
) -> Path:
    """Write a picture of the scene's points beside the upsampled ones, from one camera.

    Args:
        scene: The scene as read.
        upsampled: The points made from it.
        path: The PNG to write.
        title: What the upsampled points are, such as ``"mls, 8x"``.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: The scene has no finite points.
    """
    camera = choose_camera(scene)
    clouds = {"original": scene.points, title: upsampled}
    return write_grid(_cloud_tiles(clouds, camera, PAIR_SIDE), path, columns=2)


def preview_methods(scene: Scene, clouds: Mapping[str, PointCloud], path: Path | str) -> Path:
    """Write a grid: the photograph where there is one, the scene's points, and each cloud.

    Args:
        scene: The scene as read.
        clouds: Upsampled points by label, drawn in this order.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: The scene has no finite points.
    """
    camera = choose_camera(scene)
    tiles = _cloud_tiles({"original": scene.points, **clouds}, camera, GRID_SIDE)
    height, width = tiles[0].picture.shape[:2]
    photo = _photo(scene, (width, height))
    if photo is not None:
        tiles.insert(0, Tile("photograph", photo))
    return write_grid(tiles, path, columns=_columns(len(tiles)))


def preview_errors(
    clouds: Mapping[str, PointCloud],
    distances: Mapping[str, Float64[np.ndarray, " N"]],
    camera: Camera,
    path: Path | str,
    *,
    limit: float = 1.0,
    unit: str = "h",
) -> Path:
    """Write a grid of clouds whose points are coloured by their distance to the true surface.

    Args:
        clouds: Points by label; usually the new ones alone.
        distances: For each label the distance of every point, in ``unit``.
        camera: From where to look.
        path: The PNG to write.
        limit: Distances from here on have the colour bar's last colour.
        unit: What the colour bar counts in.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: Distances and points differ in number.
    """
    colored = {
        label: cloud.replace(rgb=heat(_matching(distances[label], cloud, label) / limit))
        for label, cloud in clouds.items()
    }
    tiles = [
        Tile(f"{tile.label}: mean error {distances[label].mean():.2f} {unit}", tile.picture)
        for label, tile in zip(colored, _cloud_tiles(colored, camera, GRID_SIDE), strict=True)
    ]
    bar = color_bar(f"0 {unit}", f"{limit:g} {unit} or more from the surface")
    return write_grid(tiles, path, columns=_columns(len(tiles)), footer=bar)


def _matching(distances: np.ndarray, cloud: PointCloud, label: str) -> np.ndarray:
    if len(distances) != len(cloud):
        raise PointCloudError(
            f"one distance for each of the {len(cloud)} points of {label!r}",
            found=f"{len(distances)}",
            fix="Pass the distances of the same points.",
        )
    return np.asarray(distances)


def heat(values: Float64[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours of values 0..1: blue is good, yellow bad, and both are told apart in grey print."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import, needed here alone)

    rgba = colormaps["plasma"](np.clip(values, 0.0, 1.0), bytes=True)
    return np.asarray(rgba[..., :3])


def _cloud_tiles(clouds: Mapping[str, PointCloud], camera: Camera, side: int) -> list[Tile]:
    scale = side / max(camera.width, camera.height)
    return [
        Tile(f"{label}   {len(cloud):,} points", render_points(cloud, camera, scale=scale))
        for label, cloud in clouds.items()
    ]


def _columns(num_tiles: int) -> int:
    """Three or four, whichever leaves fewer places empty; fewer where that is enough."""
    return num_tiles if num_tiles < 3 else min((3, 4), key=lambda columns: -num_tiles % columns)


def _photo(scene: Scene, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"] | None:
    """The chosen image's photograph, scaled to width and height; None where it cannot be read."""
    image = choose_image(scene)
    if image is None or scene.source is None or scene.source.image_dir is None:
        return None
    path = scene.source.image_dir / image.name
    try:
        picture = decode_photograph(path, photograph_bytes(path))
    except (SceneNotFoundError, SceneFormatError):
        return None  # a scene without its pictures still has points to show
    return np.asarray(picture.resize(size, PillowImage.Resampling.LANCZOS))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)


def color_bar(low: str, high: str) -> UInt8[np.ndarray, "H W 3"]:
    """A strip of the heat colours with what its two ends mean written beside it."""
    strip = np.tile(heat(np.linspace(0.0, 1.0, 240)), (20, 1, 1))
    bar = PillowImage.new("RGB", (GRID_SIDE, 44), PAPER)
    bar.paste(PillowImage.fromarray(strip), (70, 12))
    draw = ImageDraw.Draw(bar)
    draw.text((58, 22), low, fill=INK, font=_font(18), anchor="rm")
    draw.text((322, 22), high, fill=INK, font=_font(18), anchor="lm")
    return np.asarray(bar)


def write_grid(
    tiles: Sequence[Tile],
    path: Path | str,
    *,
    columns: int,
    footer: UInt8[np.ndarray, "H W 3"] | None = None,
) -> Path:
    """Set pictures of one size in rows, each with its label above, and write the PNG.

    Args:
        tiles: At least one, set row by row.
        path: The PNG to write.
        columns: Tiles in a row.
        footer: A strip below all, no wider than the page.

    Raises:
        OutputError: The file cannot be written.
    """
    gap, label_height = 12, 34
    height, width = tiles[0].picture.shape[:2]
    rows = -(-len(tiles) // columns)
    foot = 0 if footer is None else len(footer)
    page_width = columns * (width + gap) + gap
    page_height = rows * (height + label_height) + gap + foot
    page = PillowImage.new("RGB", (page_width, page_height), PAPER)
    draw = ImageDraw.Draw(page)
    for i, tile in enumerate(tiles):
        x = gap + (i % columns) * (width + gap)
        y = (i // columns) * (height + label_height)
        draw.text((x, y + label_height / 2), tile.label, fill=INK, font=_font(20), anchor="lm")
        page.paste(PillowImage.fromarray(tile.picture), (x, y + label_height))
    if footer is not None:
        page.paste(PillowImage.fromarray(footer), (gap, page_height - foot))
    with atomic_file(Path(path)) as partial:
        page.save(partial, format="PNG")
    return Path(path)
