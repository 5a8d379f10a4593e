"""Find the pixels of test views that at least two training views see.

Other pixels can only be guessed. Images are divided into the cells of ``photos.zbuffer``. A cell's
depth is that of the sensor's depth map, else of ``cell_depths``, else the median of the nearest
cells. A training view sees a point that projects into it and lies at most ``SURFACE`` (relative)
behind the depth there. The result does not depend on renders: it is the same for all models of a
scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from splatseed.depthmap import DepthMaps
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.staging import atomic_file
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.view import View, camera_views
from splatseed.photos.visibility import SURFACE, points_in_image
from splatseed.photos.zbuffer import cell_depths
from splatseed.progress import Progress, num_threads, silent
from splatseed.projection import pixel_centers
from splatseed.scene import Image, Scene

_STAGE = "find co-visible pixels"


@dataclass(frozen=True)
class CovisibilitySettings:
    """Constants of co-visibility."""

    min_views: int = 2  # training views that must see a pixel
    num_cells: int = 100  # along the longer side; the SfM points of a capture fill most of them
    min_cell: float = 2.0  # px, side of a cell
    max_side: int = 800  # px, longer side of the images that are divided into cells
    num_nearest: int = 4  # covered cells whose median inverse depth fills an empty cell


COVISIBILITY = CovisibilitySettings()

Grids = Mapping[str, Bool[np.ndarray, "rows cols"]]


def find_covisible(
    scene: Scene, test_every: int = 8, progress: Progress = silent
) -> dict[str, Bool[np.ndarray, "rows cols"]]:
    """Return the cells of each test view that at least two training views see, by view name.

    Every ``test_every``-th image is a test view. Empty for a scene without points and depth maps.

    Raises:
        SceneFormatError: A depth map is damaged.
    """
    points = scene.points.references
    xyz = np.ascontiguousarray(points.xyz[points.finite], np.float32)
    maps = scene.depths if scene.source.format in {"rgbd", "phone"} else None
    if not scene.images or (maps is None and not len(xyz)):
        return {}
    train, test = (_small_views(part, maps) for part in scene.split(test_every))
    views = [*train, *test]
    by_view: dict[str, Bool[np.ndarray, "rows cols"]] = {}
    with ThreadPoolExecutor(num_threads()) as pool:
        depths = []
        for grid in pool.map(lambda view: _depths(view, xyz, maps), views):
            depths.append(grid)
            progress(_STAGE, 0.5 * len(depths) / len(views))
        seen, own = list(zip(train, map(farthest, depths), strict=False)), depths[len(train) :]
        grids = pool.map(lambda view, grid: seen_cells(view, grid, seen), test, own)
        for view, grid in zip(test, grids, strict=True):
            by_view[view.name] = grid
            progress(_STAGE, 0.5 + 0.5 * len(by_view) / len(test))
    return by_view


def pixel_masks(grids: Grids, views: Sequence[View]) -> dict[str, Bool[np.ndarray, "H W"]]:
    """Resize the cells of ``find_covisible`` to masks of the views' pixels."""
    return {v.name: _resized(grids[v.name], v.height, v.width) for v in views if v.name in grids}


def _resized(values: np.ndarray[Any, Any], rows: int, cols: int) -> np.ndarray[Any, Any]:
    """Resample to ``rows x cols`` cells of the same frame, by nearest neighbour."""
    i = (np.arange(rows) + 0.5) * values.shape[0] / rows
    j = (np.arange(cols) + 0.5) * values.shape[1] / cols
    return values[np.ix_(i.astype(np.int64), j.astype(np.int64))]


def _cell(view: View) -> float:
    return max(max(view.width, view.height) / COVISIBILITY.num_cells, COVISIBILITY.min_cell)


def _small_views(images: Sequence[Image], maps: DepthMaps | None) -> Sequence[View]:
    """Return the images' views at most ``max_side`` large; with depth maps, of images with one."""
    known = [image for image in images if maps is None or image.name in maps]
    return camera_views(known, factor_for_size(known, COVISIBILITY.max_side)) if known else ()


def _depths(
    view: View, xyz: Float32[np.ndarray, "N 3"], maps: DepthMaps | None
) -> Float32[np.ndarray, "rows cols"]:
    """Return the planar depth of each cell, gaps filled; all infinite without any depth."""
    if maps is None:
        depths = cell_depths(view.camera, xyz, _cell(view))
    else:  # a sensor's depth is planar, in the scene's unit
        values = _resized(maps.read(view.name).values, *view.camera.grid_shape(_cell(view)))
        depths = np.nan_to_num(values, nan=np.inf)
    known = np.isfinite(depths)
    if known.any() and not known.all():
        k = min(COVISIBILITY.num_nearest, np.count_nonzero(known))
        _, near = cKDTree(np.argwhere(known)).query(np.argwhere(~known), k=k)
        inverse = 1.0 / depths[known][near.reshape(-1, k)]
        depths = depths.copy()
        depths[~known] = 1.0 / np.median(inverse, axis=1)
    return depths


def farthest(depths: Float32[np.ndarray, "rows cols"]) -> Float32[np.ndarray, "rows cols"]:
    """Return the largest depth around each cell: at depth edges both surfaces are visible."""
    return np.asarray(maximum_filter(depths, size=3, mode="nearest"))


def seen_cells(
    view: View,
    depths: Float32[np.ndarray, "rows cols"],
    others: Sequence[tuple[View, Float32[np.ndarray, "rows cols"]]],
    min_views: int = COVISIBILITY.min_views,
) -> Bool[np.ndarray, "rows cols"]:
    """Return the cells of a view that at least ``min_views`` others see.

    Args:
        view: The view.
        depths: The planar depth of its cells; infinite where unknown.
        others: Views with the ``farthest`` depths of their cells.
        min_views: Of the others, for a cell to count.
    """
    rows, cols = depths.shape
    known = np.isfinite(depths)
    # The cells' centres at their depths, in the world.
    uv = pixel_centers(rows, cols).reshape(-1, 2) * [view.width / cols, view.height / rows]
    xyz = np.asfortranarray(view.camera.unproject(uv, np.where(known, depths, -1.0).ravel()))
    count = np.zeros(rows * cols, np.int32)
    for other, limits in others:
        points = points_in_image(other.camera, xyz)
        there = limits[points.cells(other.camera, limits.shape)]
        count[points.point_idx] += there >= (1.0 - SURFACE) * points.depth
    return np.asarray((count.reshape(depths.shape) >= min_views) & known)


def write_covisible(path: Path, grids: Grids) -> None:
    """Cache the cells of ``find_covisible``."""
    names = np.array(list(grids), dtype=np.str_)
    arrays: dict[str, Any] = {f"cells_{i}": grid for i, grid in enumerate(grids.values())}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, names=names, **arrays)


def read_covisible(path: Path) -> dict[str, Bool[np.ndarray, "rows cols"]] | None:
    """Read cached cells; None if the file is missing or unreadable."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {str(name): file[f"cells_{i}"] for i, name in enumerate(file["names"])}
    except ARCHIVE_FAILURES:
        return None
