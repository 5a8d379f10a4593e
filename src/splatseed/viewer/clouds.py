"""Pages of clouds, seen from a camera of the scene or, without cameras, from one made up.

Notation: cell (i, j) of a ``covered`` grid [rows, columns] starts at pixel (``cell i``, ``cell j``)
and has ``cell`` px a side; the last row and column may extend beyond the photograph. Promise: files
appear complete, or ``OutputError`` is raised; a scene without finite points is a
``PointCloudError``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatseed.camera import Camera
from splatseed.io.files import StrPath
from splatseed.methods import SOURCE_CODES, source_name
from splatseed.photos.viewpoint import choose_camera, choose_image
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.viewer import page
from splatseed.viewer.points import COLORS, origin_colors, points_over, render_points

PAIR_SIDE = 800  # longer side of two or three pictures in a row, pixels
GREY = 215  # of a cloud without colours, paler than the ground
NEAR, FAR = np.array([0, 114, 178]), np.array([213, 94, 0])
"""Colours of points on an aligned cloud and off it."""
GUESSED = SOURCE_CODES["cover"]
"""The origin of seeds at depths that no photograph confirms."""
EMPTY, BLEND = np.array([214.0, 20.0, 190.0]), 0.6
"""Colour of cells without a seed (magenta is rare in photographs) and its opacity."""
DIM = 0.75  # brightness of the photograph under cells


class CoveredView(NamedTuple):
    """A view and the cells that held a seed before and after."""

    name: str
    photograph: UInt8[np.ndarray, "H W 3"]
    cell: int  # its side, in pixels of the photograph
    before: Bool[np.ndarray, "rows columns"]
    after: Bool[np.ndarray, "rows columns"]


def preview_pair(
    scene: Scene, upsampled: PointCloud, path: StrPath, *, title: str = "upsampled"
) -> Path:
    """Write a picture of the scene's points and one of the upsampled points, with a title.

    A scene without points is shown by its photograph. If some are guesses, a third one shows them
    in their origin's colour, and the others in grey.
    """
    path, camera = Path(path), choose_camera(scene)
    original = {"original": scene.points} if len(scene.points) else {}
    tiles = [] if original else _photograph(scene, PAIR_SIDE, "photograph")
    tiles += _cloud_tiles({**original, title: upsampled}, camera, PAIR_SIDE)
    guessed = upsampled.source == GUESSED
    if guessed.any():
        grey = upsampled.rgb.mean(axis=1, keepdims=True).astype(np.uint8)
        rgb = np.where(guessed[:, None], np.array(COLORS[GUESSED], np.uint8), grey)
        label = f"orange: {guessed.sum():,} guessed from neighbours   grey: all others"
        marked = {label: upsampled.replace(rgb=rgb)}
        tiles += _cloud_tiles(marked, camera, PAIR_SIDE, counted=False)
    return page.write_grid(tiles, path, columns=len(tiles))


def preview_methods(scene: Scene, clouds: Mapping[str, PointCloud], path: StrPath) -> Path:
    """Write a grid of the photograph if there is one, the scene's points, and clouds by label."""
    path = Path(path)
    clouds, side = {"original": scene.points, **clouds}, page.GRID_SIDE
    tiles = _photograph(scene, side, "photograph")
    return page.write_grid([*tiles, *_cloud_tiles(clouds, choose_camera(scene), side)], path)


def preview_errors(
    clouds: Mapping[str, PointCloud],
    distances: Mapping[str, Float64[np.ndarray, " N"]],
    camera: Camera,
    path: StrPath,
) -> Path:
    """Write a grid of clouds by label, coloured by the points' distance to the true surface.

    Distances are in spacings h of the originals; colours end at 1.
    """
    path = Path(path)
    colored = {
        f"{label}   {len(cloud):,} points: mean error {distances[label].mean():.2f} spacings": (
            cloud.replace(rgb=page.map_colors(distances[label], 0.0, 1.0, "plasma"))
        )
        for label, cloud in clouds.items()
    }
    tiles = _cloud_tiles(colored, camera, page.GRID_SIDE, counted=False)
    bar = page.color_bar("0", "1 spacing or more from the surface")
    return page.write_grid(tiles, path, footer=bar)


def preview_origins(scene: Scene, points: PointCloud, path: StrPath, other: str = "other") -> Path:
    """Write a page of the seeds in their own colours, and by origin over the photograph.

    ``other`` is the name of a third party's method.
    """
    path = Path(path)
    camera = choose_camera(scene)
    scale = PAIR_SIDE / max(camera.width, camera.height)
    size = page.fitted(camera.width, camera.height, PAIR_SIDE)
    photograph = page.photograph_at(choose_image(scene), size)
    colored = points.replace(rgb=origin_colors(points.source))
    tiles = [
        page.Tile(f"{len(points):,} seeds", render_points(points, camera, scale=scale)),
        page.Tile("by origin", points_over(colored, camera, photograph, scale=scale)),
    ]
    codes, counts = np.unique(points.source, return_counts=True)
    entries = {
        f"{source_name(int(code), other)}{' (guessed)' * int(code == GUESSED)} {count:,}": tuple(
            color
        )
        for code, count, color in zip(codes, counts, origin_colors(codes).tolist(), strict=True)
    }
    return page.write_grid(tiles, path, columns=2, footer=page.legend(entries, 2 * size[0]))


def preview_alignment(
    scene: Scene,
    cloud: Float64[np.ndarray, "N 3"],
    rgb: UInt8[np.ndarray, "N 3"] | None,
    tie_points: Float64[np.ndarray, "M 3"],
    residuals: Float64[np.ndarray, " M"],
    path: StrPath,
) -> Path:
    """Write a page of photograph, aligned cloud and residuals.

    ``cloud`` is a sample in the scene's frame, drawn grey without colours; ``tie_points`` are the
    scene's points that it was aligned to, with ``residuals`` from 0 (on the cloud) to 1 (outlier).
    """
    path = Path(path)
    blend = np.clip(residuals, 0, 1)[:, None]
    shades = np.rint((1 - blend) * NEAR + blend * FAR).astype(np.uint8)
    clouds = {
        "the cloud from its camera, as aligned": PointCloud(
            cloud, np.full(cloud.shape, GREY, np.uint8) if rgb is None else rgb
        ),
        "the scene's points: blue on the cloud, orange off it": PointCloud(tie_points, shades),
    }
    drawn = _cloud_tiles(clouds, choose_camera(scene), PAIR_SIDE, counted=False)
    tiles = [*_photograph(scene, PAIR_SIDE, "a photograph"), *drawn]
    return page.write_grid(tiles, path, columns=len(tiles))


def preview_cells(views: Sequence[CoveredView], path: StrPath) -> Path:
    """Write a page of the cells of each view that the originals cover, and that all seeds cover."""
    path = Path(path)
    tiles = []
    for view in views:
        size = page.fitted(view.photograph.shape[1], view.photograph.shape[0])
        for label, covered in (
            (f"{view.name[-28:]}: {view.before.mean():.1%} covered", view.before),
            (f"with new points: {view.after.mean():.1%}", view.after),
        ):
            picture = cell_picture(view.photograph, covered, view.cell)
            tiles.append(page.Tile(label, page.resized(picture, size)))
    side = f"{views[0].cell} px" if views else ""
    tint = tuple(int(each) for each in BLEND * EMPTY + (1 - BLEND) * DIM * 128)
    legend = page.legend({f"cells of {side} without a point": tint}, page.GRID_SIDE)
    return page.write_grid(tiles, path, columns=2 if len(views) == 1 else 4, footer=legend)


def cell_picture(
    photograph: UInt8[np.ndarray, "H W 3"], covered: Bool[np.ndarray, "rows columns"], cell: int
) -> UInt8[np.ndarray, "H W 3"]:
    """Dim a photograph and colour its empty cells magenta."""
    height, width = photograph.shape[:2]
    empty = ~np.kron(covered, np.ones((cell, cell), bool))[:height, :width, None]
    dimmed = DIM * photograph.astype(np.float64)
    grey = dimmed.mean(axis=2, keepdims=True)
    picture = np.where(empty, (1 - BLEND) * grey + BLEND * EMPTY, dimmed)
    return np.asarray(np.round(picture), np.uint8)


def _photograph(scene: Scene, side: int, label: str) -> list[page.Tile]:
    camera = choose_camera(scene)
    size = page.fitted(camera.width, camera.height, side)
    photograph = page.photograph_at(choose_image(scene), size)
    return [] if photograph is None else [page.Tile(label, photograph)]


def _cloud_tiles(
    clouds: Mapping[str, PointCloud], camera: Camera, side: int, *, counted: bool = True
) -> list[page.Tile]:
    scale = side / max(camera.width, camera.height)
    return [
        page.Tile(
            f"{label}   {len(cloud):,} points" if counted else label,
            render_points(cloud, camera, scale=scale),
        )
        for label, cloud in clouds.items()
    ]
