"""Depth, normals and confidence beside their photograph, and depth's agreement with SfM points.

Notation: a map is H x W values in the pixels of its own camera; depth is planar z in scene units,
normals are unit vectors in the camera's axes (x right, y down, z forward). A row of a page is one
image. Promise: near is yellow, far is violet, unknown is grey, on a logarithmic scale; pictures
show the map's pixels unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8
from PIL import Image as PillowImage, ImageDraw

from splatseed.camera import Camera
from splatseed.depth.alignment import Alignment, PlanarDepth, map_camera
from splatseed.depth.stereo import StereoMap
from splatseed.scene import Image, Scene
from splatseed.view.page import (
    UNKNOWN,
    Tile,
    color_bar,
    fitted,
    map_colors,
    photograph_or_blank,
    resized,
    usual_range,
    write_grid,
)
from splatseed.views.visibility import find_visibility

SIDE, CHECK_SIDE = 440, 480
"""The longer side of a tile, of maps and of depth that is checked."""
LABEL, CHECK_LABEL = 40, 46
"""Characters of a label that fit above it."""
LIMIT = 0.1
"""Relative errors of depth from this value on have the last colour."""
RADIUS = 2.5
"""Of an SfM point, in pixels."""


def preview_maps(
    scene: Scene, maps: Sequence[StereoMap], path: Path | str, *, most: int = 4
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
    places = np.linspace(0, len(maps) - 1, min(most, len(maps)))
    tiles: list[Tile] = []
    for each in [maps[i] for i in np.unique(places.round().astype(int))]:
        size = fitted(each.camera.width, each.camera.height, SIDE)
        tiles += map_tiles(each, photograph_or_blank(scene, by_name.get(each.name), size))
    bar = color_bar("far, 0", "near, 1; unknown is grey", "viridis")
    return write_grid(tiles, path, columns=4, footer=bar)


def map_tiles(maps: StereoMap, photograph: UInt8[np.ndarray, "H W 3"]) -> list[Tile]:
    """Photograph, depth, normals and confidence of a view: four tiles of the photograph's size.

    Args:
        maps: The maps.
        photograph: Their photograph, of any size.
    """
    known = np.isfinite(maps.depth)
    low, high = usual_range(maps.depth)
    confidence = np.where(known, maps.confidence, np.nan)
    usual = f", median {np.median(confidence[known]):.2f}" if known.any() else ""
    pictures = {
        f"depth {low:.3g} to {high:.3g}, {known.mean():.0%} known": depth_picture(maps.depth),
        "normals": normal_picture(maps.normal),
        f"confidence{usual}": map_colors(confidence, 0.0, 1.0),
    }
    size = (photograph.shape[1], photograph.shape[0])
    return [
        Tile(_shortened(maps.name, LABEL), photograph),
        *(Tile(label, resized(each, size, smooth=False)) for label, each in pictures.items()),
    ]


def depth_picture(depth: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Depth in colours: near is yellow, far is violet, on a logarithmic scale."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return _nearness_picture(-np.log(depth))


def _nearness_picture(nearness: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    return map_colors(nearness, *usual_range(nearness))


def normal_picture(normal: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Normals in colours: red to the right, green upward, blue toward the camera."""
    known = np.isfinite(normal).all(axis=2, keepdims=True)
    shares = 0.5 + 0.5 * np.where(known, normal, 0.0) * [1.0, -1.0, -1.0]
    colors = np.clip(np.round(255 * shares), 0, 255).astype(np.uint8)
    return np.asarray(np.where(known, colors, np.array(UNKNOWN, np.uint8)))


def _shortened(label: str, length: int) -> str:
    return label if len(label) <= length else f"...{label[3 - length :]}"


# Depth against SfM points -------------------------------------------------------------------------


def preview_depth(scene: Scene, alignments: Mapping[str, Alignment], path: Path) -> Path:
    """Write a page of depth maps and their agreement with the scene's points.

    A row shows an image's photograph, its depth, and its SfM points on the photograph, coloured by
    |depth of the map / depth of the point - 1|. The rows are the best and the worst aligned image,
    a typical one, and one that was left out, if there are such.

    Args:
        scene: A scene with depth maps.
        alignments: The alignments of its images, by name; at least one.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
    """
    by_name, visibility = {image.name: image for image in scene.images}, find_visibility(scene)
    used = sorted(
        (name for name, a in alignments.items() if a.rejected is None),
        key=lambda name: (np.nan_to_num(alignments[name].residual), name),
    )
    words: dict[str, str] = {}
    if used:  # a later word replaces an earlier one where there are few images
        words = {used[0]: "best", used[-1]: "worst", used[len(used) // 2]: "typical"}
    left_out = [name for name, a in alignments.items() if a.rejected is not None]
    chosen = sorted(words, key=used.index) + left_out[:1]
    tiles: list[Tile] = []
    for name in chosen:
        image = by_name[name]
        label = f"{name}, {words.get(name, 'left out')}"
        tiles += _checked(scene, image, alignments[name], visibility.of(image), label)
    return write_grid(tiles, path, columns=3, footer=color_bar("0", f"off by {LIMIT:.0%} or more"))


def _checked(
    scene: Scene, image: Image, alignment: Alignment, xyz: Float64[np.ndarray, "M 3"], label: str
) -> list[Tile]:
    """An image's row."""
    size = fitted(image.intrinsics.width, image.intrinsics.height, CHECK_SIDE)
    photograph = photograph_or_blank(scene, image, size)
    assert scene.depths is not None  # noqa: S101  (there are alignments of them)
    depth = scene.depths.read(image.name)
    camera = map_camera(depth, image)
    aligned = np.isfinite(alignment.scale)
    z: Float64[np.ndarray, "H W"] | None = None
    if depth.kind == "inverse" and not aligned:
        seen, words = _nearness_picture(depth.values), "depth, not aligned"
    else:
        scale, shift = (alignment.scale, alignment.shift) if aligned else (1.0, 0.0)
        z = PlanarDepth.of(depth, camera, scale, shift, unit_ray=False).whole()
        low, high = usual_range(z)
        seen = depth_picture(z)
        words = f"depth {low:.3g} to {high:.3g}" + ("" if aligned else ", not aligned")
    points, count = _points(photograph, z if aligned else None, camera, xyz)
    told = f"{count:,} SfM points, residual {alignment.residual:.2%}"
    if np.isnan(alignment.residual):
        told = alignment.rejected or "no SfM points see depth"
    return [
        Tile(_shortened(label, CHECK_LABEL), photograph),
        Tile(words, resized(seen, size, smooth=False)),
        Tile(_shortened(told, CHECK_LABEL), points),
    ]


def _points(
    photograph: UInt8[np.ndarray, "H W 3"],
    z_map: Float64[np.ndarray, "H W"] | None,
    camera: Camera,
    xyz: Float64[np.ndarray, "M 3"],
) -> tuple[UInt8[np.ndarray, "H W 3"], int]:
    """The SfM points that see depth on the faded photograph, the largest errors on top."""
    grey = np.repeat(photograph.mean(axis=2, keepdims=True), 3, axis=2)
    canvas = PillowImage.fromarray(np.uint8((grey + 255) / 2))
    if z_map is None:
        return np.array(canvas), 0
    uv, z = camera.project(xyz)
    inside = (z > 0) & ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
    uv, z = uv[inside], z[inside]
    column, row = uv.astype(np.int64).T
    error = np.abs(z_map[row, column] / z - 1.0)
    known = np.isfinite(error)
    uv, error = uv[known], error[known]
    uv = uv * [canvas.width / camera.width, canvas.height / camera.height]
    draw, order = ImageDraw.Draw(canvas), np.argsort(error, kind="stable")
    colors = map_colors(error[order] / LIMIT, 0.0, 1.0, "plasma").tolist()
    for (u, v), color in zip(uv[order], colors, strict=True):
        draw.ellipse((u - RADIUS, v - RADIUS, u + RADIUS, v + RADIUS), fill=tuple(color))
    return np.array(canvas), len(error)
