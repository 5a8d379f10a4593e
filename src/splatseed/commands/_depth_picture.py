"""A picture of depth beside photographs, and of how well it agrees with the SfM points.

Notation: a row is one image: its photograph, its depth (near is yellow, far is violet, unknown is
grey; logarithmic, so that both near and far are told apart), and its SfM points on the photograph,
coloured by |depth of the map / depth of the point - 1|. Promise: the images shown are a typical one,
the best and the worst aligned ones, and one that was left out, where there are such.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image as PilImage, ImageDraw

from splatseed.camera import Camera
from splatseed.depth import Alignment
from splatseed.depth.planar import PlanarDepth, map_camera
from splatseed.depthmap import DepthMap
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.preview import Tile, color_bar, heat, write_grid
from splatseed.scene import Image, Scene
from splatseed.views.sightings import find_sightings

__all__ = ["write_depth_picture"]

SIDE = 480
"""The longer side of a tile, in pixels."""
LIMIT = 0.1
"""Relative errors from here on have the last colour."""
RANGE = (2, 98)
"""Percentiles of depth between which colours change."""
RADIUS = 2.5
UNKNOWN = (150, 150, 150)
PAPER = (255, 255, 255)
NO_PHOTOGRAPH = (230, 230, 230)

Size = tuple[int, int]


def write_depth_picture(scene: Scene, alignments: Mapping[str, Alignment], path: Path) -> Path:
    """Write the picture.

    Args:
        scene: A scene with depth maps.
        alignments: Of its images, by name; at least one.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
    """
    by_name, sightings = {image.name: image for image in scene.images}, find_sightings(scene)
    rows: list[Tile] = []
    for name, why in _chosen(alignments).items():
        image = by_name[name]
        rows += _row(scene, image, alignments[name], sightings.of(image), why)
    height, width = np.max([tile.picture.shape[:2] for tile in rows], axis=0)
    tiles = [Tile(tile.label, _centered(tile.picture, height, width)) for tile in rows]
    bar = color_bar("0", f"off by {LIMIT:.0%} or more")
    return write_grid(tiles, path, columns=3, footer=bar)


def _chosen(alignments: Mapping[str, Alignment]) -> dict[str, str]:
    """Names of images to show, and what each stands for."""
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
    size = _fit(image.intrinsics.width, image.intrinsics.height)
    photograph = _photograph(scene, image, size)
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


def _photograph(scene: Scene, image: Image, size: Size) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph at a size; plain grey where it cannot be had."""
    folder = scene.source.image_dir if scene.source else None
    try:
        if folder is not None:
            path = folder / image.name
            picture = decode_photograph(path, photograph_bytes(path))
            return np.array(picture.resize(size, PilImage.Resampling.LANCZOS))
    except (SceneNotFoundError, SceneFormatError):
        pass  # depth without its photographs is still worth a look
    return np.full((size[1], size[0], 3), NO_PHOTOGRAPH, np.uint8)


def _depth_colors(
    depth: DepthMap, camera: Camera, alignment: Alignment
) -> tuple[UInt8[np.ndarray, "H W 3"], str]:
    """The map in colours, and what its range is."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import, needed here alone)

    aligned = np.isfinite(alignment.scale)
    if depth.kind == "inverse" and not aligned:
        nearness, words = depth.values, "depth, not aligned"
    else:
        z = _planar(depth, camera, alignment if aligned else Alignment(1.0, 0.0, 0, np.nan))
        low, high = _range(z)
        words = f"depth {low:.3g} to {high:.3g}" + ("" if aligned else ", not aligned")
        with np.errstate(divide="ignore", invalid="ignore"):
            nearness = -np.log(z)
    low, high = _range(nearness)
    share = (nearness - low) / max(high - low, 1e-12)
    colors = colormaps["viridis"](np.clip(np.nan_to_num(share), 0.0, 1.0), bytes=True)[..., :3]
    return np.where(np.isfinite(nearness)[..., None], colors, np.array(UNKNOWN, np.uint8)), words


def _planar(depth: DepthMap, camera: Camera, alignment: Alignment) -> Float64[np.ndarray, "H W"]:
    """Planar depth in scene units; NaN where unknown."""
    return PlanarDepth.of(depth, camera, alignment.scale, alignment.shift, unit_ray=False).whole()


def _range(values: Float64[np.ndarray, "H W"] | Float32[np.ndarray, "H W"]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 0.0
    low, high = np.percentile(finite, RANGE)
    return float(low), float(high)


def _points(
    photograph: UInt8[np.ndarray, "H W 3"],
    depth: DepthMap,
    camera: Camera,
    alignment: Alignment,
    xyz: Float64[np.ndarray, "M 3"],
) -> tuple[UInt8[np.ndarray, "H W 3"], int]:
    """SfM points on the paled photograph, the largest errors on top, and how many there are."""
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
    """Where points that see depth are, in pixels of the map, and their relative errors."""
    uv, z = camera.project(xyz)
    inside = (z > 0) & ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
    uv, z = uv[inside], z[inside]
    column, row = uv.astype(np.int64).T
    error = np.abs(z_map[row, column] / z - 1.0)
    known = np.isfinite(error)
    return uv[known], error[known]


def _fit(width: int, height: int) -> Size:
    factor = SIDE / max(width, height)
    return max(round(width * factor), 1), max(round(height * factor), 1)


def _centered(
    picture: UInt8[np.ndarray, "h w 3"], height: int, width: int
) -> UInt8[np.ndarray, "H W 3"]:
    """On white, as tiles are of one size and images of a scene may not be."""
    tile = np.full((height, width, 3), PAPER, np.uint8)
    top, left = (height - len(picture)) // 2, (width - picture.shape[1]) // 2
    tile[top : top + len(picture), left : left + picture.shape[1]] = picture
    return tile
