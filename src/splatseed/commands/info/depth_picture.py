"""A picture of depth beside photographs, and of its agreement with the SfM points.

Notation: a row is one image: its photograph, its depth (near is yellow, far is violet, unknown is
grey; on a logarithmic scale), and its SfM points on the photograph, coloured by |depth of the map /
depth of the point - 1|. Promise: it shows a typical image, the best and the worst aligned, and one
that was left out, if there are such.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image as PilImage, ImageDraw

from splatseed.camera import Camera
from splatseed.depth import Alignment
from splatseed.depth.planar import PlanarDepth, map_camera
from splatseed.depthmap import DepthMap
from splatseed.preview.colors import color_bar, heat, map_colors, usual_range
from splatseed.preview.page import Tile, centered, fitted, write_grid
from splatseed.preview.photographs import photograph_or_blank
from splatseed.scene import Image, Scene
from splatseed.views.visibility import find_visibility

SIDE = 480
"""The longer side of a tile, in pixels."""
LIMIT = 0.1
"""Relative errors from this value on have the last colour."""
RADIUS = 2.5


def write_depth_picture(scene: Scene, alignments: Mapping[str, Alignment], path: Path) -> Path:
    """Write the picture.

    Args:
        scene: A scene with depth maps.
        alignments: The alignments of its images, by name; at least one.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
    """
    by_name, visibility = {image.name: image for image in scene.images}, find_visibility(scene)
    rows: list[Tile] = []
    for name, why in _chosen(alignments).items():
        image = by_name[name]
        rows += _row(scene, image, alignments[name], visibility.of(image), why)
    bar = color_bar("0", f"off by {LIMIT:.0%} or more")
    return write_grid(centered(rows), path, columns=3, footer=bar)


def _chosen(alignments: Mapping[str, Alignment]) -> dict[str, str]:
    """Names of images to show, and why each was chosen."""
    used = sorted(
        (name for name, a in alignments.items() if a.rejected is None),
        key=lambda name: (np.nan_to_num(alignments[name].residual), name),
    )
    words = {}
    if used:  # a later word replaces an earlier one where there are few images
        words = {used[0]: "best", used[-1]: "worst", used[len(used) // 2]: "typical"}
    chosen = {name: words[name] for name in used if name in words}
    left_out = [name for name, a in alignments.items() if a.rejected is not None]
    return chosen | dict.fromkeys(left_out[:1], "left out")


def _row(
    scene: Scene,
    image: Image,
    alignment: Alignment,
    xyz: Float64[np.ndarray, "M 3"],
    why: str,
) -> list[Tile]:
    size = fitted(image.intrinsics.width, image.intrinsics.height, SIDE)
    photograph = photograph_or_blank(scene, image, size)
    if scene.depths is None:
        return []
    depth = scene.depths.read(image.name)
    camera = map_camera(depth, image)
    seen, words = _depth_colors(depth, camera, alignment)
    colored = np.asarray(PilImage.fromarray(seen).resize(size, PilImage.Resampling.NEAREST))
    points, count = _points(photograph, depth, camera, alignment, xyz)
    return [
        Tile(_shortened(f"{image.name}, {why}"), photograph),
        Tile(words, colored),
        Tile(_told(alignment, count), points),
    ]


def _told(alignment: Alignment, count: int) -> str:
    if np.isnan(alignment.residual):
        return _shortened(alignment.rejected or "no SfM points see depth")
    return f"{count:,} SfM points, residual {alignment.residual:.2%}"


def _shortened(label: str, length: int = 46) -> str:
    return label if len(label) <= length else f"...{label[3 - length :]}"


def _depth_colors(
    depth: DepthMap, camera: Camera, alignment: Alignment
) -> tuple[UInt8[np.ndarray, "H W 3"], str]:
    """The map in colours, and its range in words."""
    aligned = np.isfinite(alignment.scale)
    if depth.kind == "inverse" and not aligned:
        nearness, words = depth.values, "depth, not aligned"
    else:
        z = _planar(depth, camera, alignment if aligned else Alignment(1.0, 0.0, 0, np.nan))
        low, high = usual_range(z)
        words = f"depth {low:.3g} to {high:.3g}" + ("" if aligned else ", not aligned")
        with np.errstate(divide="ignore", invalid="ignore"):
            nearness = -np.log(z)
    return map_colors(nearness, *usual_range(nearness)), words


def _planar(depth: DepthMap, camera: Camera, alignment: Alignment) -> Float64[np.ndarray, "H W"]:
    """Planar depth in scene units; NaN where unknown."""
    return PlanarDepth.of(depth, camera, alignment.scale, alignment.shift, unit_ray=False).whole()


def _points(
    photograph: UInt8[np.ndarray, "H W 3"],
    depth: DepthMap,
    camera: Camera,
    alignment: Alignment,
    xyz: Float64[np.ndarray, "M 3"],
) -> tuple[UInt8[np.ndarray, "H W 3"], int]:
    """SfM points on the faded photograph, the largest errors on top, and their number."""
    grey = np.repeat(photograph.mean(axis=2, keepdims=True), 3, axis=2)
    canvas = PilImage.fromarray(np.uint8((grey + 255) / 2))
    if not np.isfinite(alignment.scale):
        return np.array(canvas), 0
    uv, error = _errors(_planar(depth, camera, alignment), camera, xyz)
    uv = uv * [canvas.width / camera.width, canvas.height / camera.height]
    draw, order = ImageDraw.Draw(canvas), np.argsort(error, kind="stable")
    for (u, v), color in zip(uv[order], heat(error[order] / LIMIT), strict=True):
        box = (u - RADIUS, v - RADIUS, u + RADIUS, v + RADIUS)
        draw.ellipse(box, fill=tuple(color.tolist()))
    return np.array(canvas), len(error)


def _errors(
    z_map: Float64[np.ndarray, "H W"], camera: Camera, xyz: Float64[np.ndarray, "M 3"]
) -> tuple[Float64[np.ndarray, "K 2"], Float64[np.ndarray, " K"]]:
    """Positions of points that see depth, in pixels of the map, and their relative errors."""
    uv, z = camera.project(xyz)
    inside = (z > 0) & ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
    uv, z = uv[inside], z[inside]
    column, row = uv.astype(np.int64).T
    error = np.abs(z_map[row, column] / z - 1.0)
    known = np.isfinite(error)
    return uv[known], error[known]
