"""Pages of depth, normals and confidence, and of depth's agreement with SfM points.

Notation: a map is H x W values in the pixels of its own camera; depth is planar z in scene units,
normals are unit vectors in the camera's axes (x right, y down, z forward). A row of a page is an
image. Promise: pictures show the map's pixels unchanged; a page that cannot be written is an
``OutputError``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8

from splatseed.depth.alignment import Alignment, PlanarDepth, map_camera
from splatseed.depth.settings import DepthSettings
from splatseed.depth.stereo import StereoMap
from splatseed.io.files import StrPath
from splatseed.photos.visibility import find_visibility, points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.sampling import evenly_spaced
from splatseed.scene import Image, Scene
from splatseed.viewer import page
from splatseed.viewer.points import points_over

(SIDE, LABEL), (CHECK_SIDE, CHECK_LABEL) = (440, 40), (480, 46)
"""Longer side of a tile, and characters that fit above it, of maps and of checked depth."""
LIMIT = 0.1
"""Relative error of depth at the end of the colours."""


def preview_maps(scene: Scene, maps: Sequence[StereoMap], path: StrPath, *, limit: int = 4) -> Path:
    """Write a page with a row of ``map_tiles`` for up to ``limit`` of the maps, evenly spaced.

    A photograph that cannot be read is grey.
    """
    path = Path(path)
    by_name = {image.name: image for image in scene.images}
    tiles: list[page.Tile] = []
    for i in evenly_spaced(len(maps), limit):
        size = page.fitted(maps[i].camera.width, maps[i].camera.height, SIDE)
        photograph = page.photograph_or_blank(by_name.get(maps[i].name), size)
        tiles += map_tiles(maps[i], photograph)
    bar = page.color_bar("far; confidence 0", "near; confidence 1; grey: unknown", "viridis")
    return page.write_grid(tiles, path, columns=4, footer=bar)


def map_tiles(stereo_map: StereoMap, photograph: UInt8[np.ndarray, "H W 3"]) -> list[page.Tile]:
    """Photograph, depth, normals and confidence of a view: tiles of the photograph's size."""
    depth, known = stereo_map.depth, np.isfinite(stereo_map.depth)
    low, high = page.value_range(depth)
    confidence = np.where(known, stereo_map.confidence, np.nan)
    median = f", median {np.median(confidence[known]):.2f}" if known.any() else ""
    pictures = {
        f"depth {low:.3g} to {high:.3g}, {known.mean():.0%} known": page.depth_picture(depth),
        "normals": normal_picture(stereo_map.normal),
        f"confidence{median}": page.map_colors(confidence, 0.0, 1.0),
    }
    size = (photograph.shape[1], photograph.shape[0])
    tiles = [page.Tile(k, page.resized(p, size, smooth=False)) for k, p in pictures.items()]
    return [page.Tile(_shortened(stereo_map.name, LABEL), photograph), *tiles]


def normal_picture(normal: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Map normals to colours: red to the right, green upward, blue toward the camera."""
    known = np.isfinite(normal).all(axis=2, keepdims=True)
    levels = 0.5 + 0.5 * np.where(known, normal, 0.0) * [1.0, -1.0, -1.0]
    colors = np.clip(np.round(255 * levels), 0, 255).astype(np.uint8)
    return np.asarray(np.where(known, colors, np.array(page.UNKNOWN, np.uint8)))


def _shortened(label: str, length: int) -> str:
    return label if len(label) <= length else f"...{label[3 - length :]}"


def preview_depth(scene: Scene, alignments: Mapping[str, Alignment], path: StrPath) -> Path:
    """Write a page of depth maps and their agreement with the scene's points.

    A row shows a photograph, its depth, and its SfM points coloured by |depth of the map / depth of
    the point - 1|. Rows are the best and the worst aligned image, a typical image, and an image
    that is left out, if there is any. ``alignments`` are by image name.
    """
    path = Path(path)
    by_name, visibility = {image.name: image for image in scene.images}, find_visibility(scene)
    used = sorted(
        (name for name, a in alignments.items() if a.rejected is None),
        key=lambda name: (np.nan_to_num(alignments[name].residual), name),
    )
    ranks: dict[str, str] = {}
    if used:  # a later rank replaces an earlier one if there are few images
        ranks = {used[0]: "best", used[-1]: "worst", used[len(used) // 2]: "typical"}
    left_out = [name for name, a in alignments.items() if a.rejected is not None]
    tiles: list[page.Tile] = []
    for name in sorted(ranks, key=used.index) + left_out[:1]:
        image, label = by_name[name], f"{name}, {ranks.get(name, 'left out')}"
        tiles += _checked(scene, image, alignments[name], visibility.of(image), label)
    bar = page.color_bar("points: depth agrees", f"off by {LIMIT:.0%} or more")
    return page.write_grid(tiles, path, columns=3, footer=bar)


def _checked(
    scene: Scene, image: Image, alignment: Alignment, xyz: Float64[np.ndarray, "M 3"], label: str
) -> list[page.Tile]:
    size = page.fitted(image.camera.width, image.camera.height, CHECK_SIDE)
    photograph = page.photograph_or_blank(image, size)
    assert scene.depths is not None  # noqa: S101  (there are alignments of them)
    depth = scene.depths.read(image.name).reliable(DepthSettings.min_confidence)
    camera = map_camera(depth, image)
    aligned, points = np.isfinite(alignment.scale), PointCloud.empty()
    if depth.kind == "inverse" and not aligned:
        picture = page.map_colors(depth.values, *page.value_range(depth.values))
        caption = "depth, not aligned"
    else:
        scale, shift = (alignment.scale, alignment.shift) if aligned else (1.0, 0.0)
        z = PlanarDepth.from_map(depth, camera, scale, shift, unit_ray=False).full()
        low, high = page.value_range(z)
        picture = page.depth_picture(z)
        caption = f"depth {low:.3g} (yellow) to {high:.3g} (violet)"
        caption += "" if aligned else ", not aligned"
        seen = points_in_image(camera, xyz)
        column, row = seen.uv.astype(np.int64).T
        error = np.abs(z[row, column] / seen.depth - 1.0)
        known = np.isfinite(error) & aligned
        colors = page.map_colors(error[known] / LIMIT, 0.0, 1.0, "plasma")
        points = PointCloud(xyz[seen.point_idx][known], colors)
    agreement = f"{len(points):,} SfM points, residual {alignment.residual:.2%}"
    if np.isnan(alignment.residual):
        agreement = alignment.rejected or "no SfM points on known depth"
    over = points_over(points, camera, photograph, scale=size[0] / camera.width)
    return [
        page.Tile(_shortened(label, CHECK_LABEL), photograph),
        page.Tile(caption, page.resized(picture, size, smooth=False)),
        page.Tile(_shortened(agreement, CHECK_LABEL), over),
    ]
