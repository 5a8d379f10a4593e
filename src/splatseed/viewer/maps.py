"""Depth, normals and confidence beside their photograph, and depth's agreement with SfM points.

Notation: a map is H x W values in the pixels of its own camera; depth is planar z in scene units,
normals are unit vectors in the camera's axes (x right, y down, z forward). A row of a page is one
image. Promise: pictures show the map's pixels unchanged; ``OutputError`` if a page cannot be
written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8

from splatseed.depth.alignment import Alignment, PlanarDepth, map_camera
from splatseed.depth.stereo import StereoMap
from splatseed.io.files import StrPath
from splatseed.photos.visibility import find_visibility
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.viewer import page
from splatseed.viewer.points import points_over

(SIDE, LABEL), (CHECK_SIDE, CHECK_LABEL) = (440, 40), (480, 46)
"""The longer side of a tile, and characters that fit above it, of maps and of checked depth."""
LIMIT = 0.1
"""Relative errors of depth from this value on have the last colour."""


def preview_maps(scene: Scene, maps: Sequence[StereoMap], path: StrPath, *, most: int = 4) -> Path:
    """Write a page with a row of ``map_tiles`` for at most so many of the maps, evenly chosen.

    Grey stands in for a photograph that cannot be read.
    """
    path = Path(path)
    by_name = {image.name: image for image in scene.images}
    places = np.linspace(0, len(maps) - 1, min(most, len(maps)))
    tiles: list[page.Tile] = []
    for each in [maps[i] for i in np.unique(places.round().astype(int))]:
        size = page.fitted(each.camera.width, each.camera.height, SIDE)
        tiles += map_tiles(each, page.photograph_or_blank(scene, by_name.get(each.name), size))
    bar = page.color_bar("far, 0", "near, 1; unknown is grey", "viridis")
    return page.write_grid(tiles, path, columns=4, footer=bar)


def map_tiles(maps: StereoMap, photograph: UInt8[np.ndarray, "H W 3"]) -> list[page.Tile]:
    """Photograph, depth, normals and confidence of a view: four tiles of the photograph's size."""
    known = np.isfinite(maps.depth)
    low, high = page.usual_range(maps.depth)
    confidence = np.where(known, maps.confidence, np.nan)
    usual = f", median {np.median(confidence[known]):.2f}" if known.any() else ""
    pictures = {
        f"depth {low:.3g} to {high:.3g}, {known.mean():.0%} known": page.depth_picture(maps.depth),
        "normals": normal_picture(maps.normal),
        f"confidence{usual}": page.map_colors(confidence, 0.0, 1.0),
    }
    size = (photograph.shape[1], photograph.shape[0])
    tiles = [page.Tile(k, page.resized(each, size, smooth=False)) for k, each in pictures.items()]
    return [page.Tile(_shortened(maps.name, LABEL), photograph), *tiles]


def normal_picture(normal: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Normals in colours: red to the right, green upward, blue toward the camera."""
    known = np.isfinite(normal).all(axis=2, keepdims=True)
    shares = 0.5 + 0.5 * np.where(known, normal, 0.0) * [1.0, -1.0, -1.0]
    colors = np.clip(np.round(255 * shares), 0, 255).astype(np.uint8)
    return np.asarray(np.where(known, colors, np.array(page.UNKNOWN, np.uint8)))


def _shortened(label: str, length: int) -> str:
    return label if len(label) <= length else f"...{label[3 - length :]}"


def preview_depth(scene: Scene, alignments: Mapping[str, Alignment], path: StrPath) -> Path:
    """Write a page of depth maps and their agreement with the scene's points.

    A row shows an image's photograph, its depth, and its SfM points on the photograph, coloured by
    |depth of the map / depth of the point - 1|. The rows are the best and the worst aligned image,
    a typical one, and one that was left out, if there are such. Alignments are by name.
    """
    path = Path(path)
    by_name, visibility = {image.name: image for image in scene.images}, find_visibility(scene)
    used = sorted(
        (name for name, a in alignments.items() if a.rejected is None),
        key=lambda name: (np.nan_to_num(alignments[name].residual), name),
    )
    words: dict[str, str] = {}
    if used:  # a later word replaces an earlier one where there are few images
        words = {used[0]: "best", used[-1]: "worst", used[len(used) // 2]: "typical"}
    left_out = [name for name, a in alignments.items() if a.rejected is not None]
    tiles: list[page.Tile] = []
    for name in sorted(words, key=used.index) + left_out[:1]:
        image, label = by_name[name], f"{name}, {words.get(name, 'left out')}"
        tiles += _checked(scene, image, alignments[name], visibility.of(image), label)
    bar = page.color_bar("0", f"off by {LIMIT:.0%} or more")
    return page.write_grid(tiles, path, columns=3, footer=bar)


def _checked(
    scene: Scene, image: Image, alignment: Alignment, xyz: Float64[np.ndarray, "M 3"], label: str
) -> list[page.Tile]:
    """An image's row."""
    size = page.fitted(image.intrinsics.width, image.intrinsics.height, CHECK_SIDE)
    photograph = page.photograph_or_blank(scene, image, size)
    assert scene.depths is not None  # noqa: S101  (there are alignments of them)
    depth = scene.depths.read(image.name)
    camera = map_camera(depth, image)
    aligned, points = np.isfinite(alignment.scale), PointCloud.empty()
    if depth.kind == "inverse" and not aligned:
        seen = page.map_colors(depth.values, *page.usual_range(depth.values))
        words = "depth, not aligned"
    else:
        scale, shift = (alignment.scale, alignment.shift) if aligned else (1.0, 0.0)
        z = PlanarDepth.from_map(depth, camera, scale, shift, unit_ray=False).full()
        low, high = page.usual_range(z)
        seen = page.depth_picture(z)
        words = f"depth {low:.3g} to {high:.3g}" + ("" if aligned else ", not aligned")
        uv, true = camera.project(xyz)
        inside = (true > 0) & ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
        column, row = uv[inside].astype(np.int64).T
        error = np.abs(z[row, column] / true[inside] - 1.0)
        known = np.isfinite(error) & aligned
        colors = page.map_colors(error[known] / LIMIT, 0.0, 1.0, "plasma")
        points = PointCloud(xyz[inside][known], colors)
    told = f"{len(points):,} SfM points, residual {alignment.residual:.2%}"
    if np.isnan(alignment.residual):
        told = alignment.rejected or "no SfM points see depth"
    over = points_over(points, camera, photograph, scale=size[0] / camera.width)
    return [
        page.Tile(_shortened(label, CHECK_LABEL), photograph),
        page.Tile(words, page.resized(seen, size, smooth=False)),
        page.Tile(_shortened(told, CHECK_LABEL), over),
    ]
