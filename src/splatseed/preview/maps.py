"""Depth, normals and confidence beside their photograph.

Notation: a map is H x W values in the pixels of its own camera; depth is planar z in scene units,
normals are unit vectors in the camera's axes (x right, y down, z forward). Promise: unknown values
are grey; all pictures in a row have one size, and show the map's pixels unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image as PillowImage

from splatseed.camera import Camera
from splatseed.preview.colors import UNKNOWN, color_bar, map_colors, usual_range
from splatseed.preview.page import Tile, centered, fitted, write_grid
from splatseed.preview.photographs import photograph_or_blank
from splatseed.scene import Scene

SIDE = 440
LABEL = 40
"""Characters of a label that fit above a tile."""


class ViewMaps(Protocol):
    """Maps of a photograph's pixels; ``splatseed.stereo`` makes such maps."""

    @property
    def name(self) -> str:
        """The image's name."""

    @property
    def camera(self) -> Camera:
        """The camera, in pixels of the maps."""

    @property
    def depth(self) -> Float[np.ndarray, "H W"]:
        """Planar z, scene units; NaN where unknown."""

    @property
    def normal(self) -> Float[np.ndarray, "H W 3"]:
        """Unit vectors in the camera's axes; NaN where unknown."""

    @property
    def confidence(self) -> Float[np.ndarray, "H W"]:
        """0 to 1."""


Maps = TypeVar("Maps", bound=ViewMaps)


def preview_maps(
    scene: Scene, maps: Sequence[ViewMaps], path: Path | str, *, most: int = 4
) -> Path:
    """Write a page with a row of ``map_tiles`` for a few maps, evenly chosen.

    Args:
        scene: The scene of the photographs; grey stands in for one that cannot be read.
        maps: At least one.
        path: The PNG to write.
        most: The most rows.

    Raises:
        OutputError: The file cannot be written.
    """
    by_name = {image.name: image for image in scene.images}
    tiles: list[Tile] = []
    for each in _spread(maps, most):
        size = fitted(each.camera.width, each.camera.height, SIDE)
        tiles += map_tiles(each, photograph_or_blank(scene, by_name.get(each.name), size))
    bar = color_bar("far, 0", "near, 1; unknown is grey", "viridis")
    return write_grid(centered(tiles), path, columns=4, footer=bar)


def map_tiles(maps: ViewMaps, photograph: UInt8[np.ndarray, "H W 3"]) -> list[Tile]:
    """Photograph, depth, normals and confidence of a view: four tiles of the photograph's size.

    Args:
        maps: The maps.
        photograph: Their photograph, of any size.
    """
    known = np.isfinite(maps.depth)
    low, high = usual_range(maps.depth)
    confidence = np.where(known, maps.confidence, np.nan)
    usual = f", median {np.median(confidence[known]):.2f}" if known.any() else ""
    name = maps.name if len(maps.name) <= LABEL else f"...{maps.name[3 - LABEL :]}"
    pictures = {
        f"depth {low:.3g} to {high:.3g}, {known.mean():.0%} known": depth_picture(maps.depth),
        "normals": normal_picture(maps.normal),
        f"confidence{usual}": map_colors(confidence, 0.0, 1.0),
    }
    height, width = photograph.shape[:2]
    return [
        Tile(name, photograph),
        *(Tile(label, _resized(each, (width, height))) for label, each in pictures.items()),
    ]


def depth_picture(depth: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Depth in colours: near is yellow, far is violet, on a logarithmic scale."""
    with np.errstate(divide="ignore", invalid="ignore"):
        nearness = -np.log(depth)
    return map_colors(nearness, *usual_range(nearness))


def normal_picture(normal: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Normals in colours: red to the right, green upward, blue toward the camera."""
    known = np.isfinite(normal).all(axis=2, keepdims=True)
    shares = 0.5 + 0.5 * np.where(known, normal, 0.0) * [1.0, -1.0, -1.0]
    colors = np.clip(np.round(255 * shares), 0, 255).astype(np.uint8)
    return np.asarray(np.where(known, colors, np.array(UNKNOWN, np.uint8)))


def _spread(maps: Sequence[Maps], most: int) -> list[Maps]:
    """At most ``most`` of them, evenly chosen."""
    places = np.linspace(0, len(maps) - 1, min(most, len(maps)))
    return [maps[i] for i in np.unique(places.round().astype(int))]


def _resized(
    picture: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "H W 3"]:
    """Nearest neighbour: blending known and unknown pixels would invent depths."""
    resized = PillowImage.fromarray(picture).resize(size, PillowImage.Resampling.NEAREST)
    return np.asarray(resized)
