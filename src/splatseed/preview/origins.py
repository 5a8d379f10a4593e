"""Seeds by origin: each point in the colour of the method that made it.

Notation: an origin is a ``PointCloud.source`` code. Promise: the same code has the same colour in
every picture; the methods that are mixed in one cloud have colours that the colour-blind can tell
apart (Okabe and Ito).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import UInt8
from PIL import Image as PillowImage, ImageDraw

from splatseed.camera import Camera
from splatseed.pointcloud import GENERATED, ORIGINAL, PointCloud
from splatseed.preview.page import INK, PAPER, Tile, font, write_grid
from splatseed.preview.photographs import photograph_at
from splatseed.preview.points import render_points
from splatseed.scene import Scene
from splatseed.upsample.registry import SOURCE_CODES, origin_name
from splatseed.views.viewpoint import choose_camera, choose_image

SIDE = 800
POINT_SIZE = 3.0
COLORS: Mapping[int, tuple[int, int, int]] = MappingProxyType(
    {
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
)
"""The colour of each origin; others have that of ``GENERATED``."""
PALE = 0.7
"""How far a photograph behind points is bleached."""


def origin_colors(source: UInt8[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """The colour of each point's origin."""
    table = np.tile(np.array(COLORS[GENERATED], np.uint8), (256, 1))
    for code, color in COLORS.items():
        table[code] = color
    return np.asarray(table[source])


def origin_picture(
    points: PointCloud,
    camera: Camera,
    photograph: UInt8[np.ndarray, "h w 3"] | None = None,
    *,
    scale: float = 1.0,
) -> UInt8[np.ndarray, "H W 3"]:
    """The points in the colours of their origins, over the bleached photograph.

    Args:
        points: Seeds, world coordinates.
        camera: The camera to look from.
        photograph: Its photograph, of any size; white when left out.
        scale: Size of the picture relative to the camera's.
    """
    size = (max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
    return render_points(
        points.replace(rgb=origin_colors(points.source)),
        camera,
        point_size=POINT_SIZE,
        background=PAPER if photograph is None else _bleached(photograph, size),
        scale=scale,
    )


def _bleached(
    photograph: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "H W 3"]:
    """Grey and pale, so that every colour of an origin stands out on it."""
    grey = PillowImage.fromarray(photograph).convert("L")
    resized = np.asarray(grey.resize(size, PillowImage.Resampling.LANCZOS), np.float64)
    pale = np.round(PALE * 255 + (1 - PALE) * resized).astype(np.uint8)
    return np.repeat(pale[..., None], 3, axis=2)


def origin_legend(points: PointCloud, width: int) -> UInt8[np.ndarray, "H W 3"]:
    """A strip that names the origins of a cloud's points, with their colours and numbers."""
    codes, counts = np.unique(points.source, return_counts=True)
    colors = [tuple(color) for color in origin_colors(codes.astype(np.uint8)).tolist()]
    strip = PillowImage.new("RGB", (width, 44), PAPER)
    draw, letters = ImageDraw.Draw(strip), font(18)
    x = 8.0
    for code, count, color in zip(codes.tolist(), counts.tolist(), colors, strict=True):
        words = f"{origin_name(code)} {count:,}"
        draw.ellipse((x, 14, x + 16, 30), fill=color)
        draw.text((x + 24, 22), words, fill=INK, font=letters, anchor="lm")
        x += 24 + letters.getlength(words) + 28
    return np.asarray(strip)


def preview_origins(scene: Scene, points: PointCloud, path: Path | str) -> Path:
    """Write a page: the seeds in their own colours, and by origin over the photograph.

    Args:
        scene: The scene as read; one of its cameras is chosen.
        points: The seeds.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
        PointCloudError: The scene has no finite points.
    """
    camera, image = choose_camera(scene), choose_image(scene)
    scale = SIDE / max(camera.width, camera.height)
    own = render_points(points, camera, scale=scale)
    size = (own.shape[1], own.shape[0])
    photograph = None if image is None else photograph_at(scene, image, size)
    by_origin = origin_picture(points, camera, photograph, scale=scale)
    tiles = [Tile(f"{len(points):,} seeds", own), Tile("by origin", by_origin)]
    legend = origin_legend(points, 2 * size[0])
    return write_grid(tiles, path, columns=2, footer=legend)
