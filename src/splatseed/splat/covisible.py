"""Which pixels of the test views at least two training views see: where scores measure skill.

What fewer show can only be guessed. Images are divided into the cells of ``photos.zbuffer``. A
cell's depth is that of the scene's own depth map, else ``cell_depths``, or the median of the
nearest cells. A training view sees a point that projects into it and lies no more than ``SURFACE``
behind the depth there. Promise: the answer depends on cameras, points and
depth maps alone, never on a render, so it is the same for everything that is scored on a scene.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32

from splatseed.depthmap import DepthMaps
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.staging import atomic_file
from splatseed.photos.projection import grid_shape
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.view import View, camera_views
from splatseed.photos.visibility import SURFACE, points_in_image
from splatseed.photos.zbuffer import cell_depths
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene

_LEAST_VIEWS = 2  # training views that must see a pixel
_CELLS, _LEAST_CELL = 100, 2.0
"""Cells along the longer side (the SfM points of a capture fill most of so many), and the smallest
side of a cell, in pixels."""
_MAX_SIZE = 800  # longer side in pixels of the frames that are divided into cells
_NEAREST = 4  # covered cells over which an empty cell takes the median of inverse depth
_STAGE = "find co-visible pixels"

Grids = Mapping[str, Bool[np.ndarray, "rows cols"]]


def find_covisible(
    scene: Scene, test_every: int = 8, progress: Progress = silent
) -> dict[str, Bool[np.ndarray, "rows cols"]]:
    """The cells of each test view that at least two training views see, by the view's name.

    Every ``test_every``-th image is a test view; none if there are neither points nor depth maps.

    Raises:
        SceneFormatError: A depth map is damaged.
    """
    from scipy.ndimage import maximum_filter  # noqa: PLC0415  (slow to import)

    points = scene.points.references
    xyz = np.ascontiguousarray(points.xyz[points.finite], np.float32)
    maps = scene.depths if scene.source and scene.source.format == "rgbd" else None
    if not scene.images or (maps is None and not len(xyz)):
        return {}
    train, test = (_frames(part, maps) for part in scene.split(test_every))
    views = [*train, *test]
    by_view: dict[str, Bool[np.ndarray, "rows cols"]] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        depths = []
        for grid in pool.map(lambda view: _depths(view, xyz, maps), views):
            depths.append(grid)
            progress(_STAGE, 0.5 * len(depths) / len(views))
        # At an edge both surfaces count as seen: each cell's depth is its neighbours' largest.
        farthest = (maximum_filter(grid, size=3, mode="nearest") for grid in depths)
        seen, own = list(zip(train, farthest, strict=False)), depths[len(train) :]
        grids = pool.map(lambda view, grid: _covisible(view, grid, seen), test, own)
        for view, grid in zip(test, grids, strict=True):
            by_view[view.name] = grid
            progress(_STAGE, 0.5 + 0.5 * len(by_view) / len(test))
    return by_view


def pixel_masks(grids: Grids, views: Sequence[View]) -> dict[str, Bool[np.ndarray, "H W"]]:
    """The cells that ``find_covisible`` found as masks of the pixels of views of any size."""
    return {v.name: _resized(grids[v.name], v.height, v.width) for v in views if v.name in grids}


def _resized(values: np.ndarray[Any, Any], rows: int, cols: int) -> np.ndarray[Any, Any]:
    """The nearest value at the centres of ``rows x cols`` cells of the same frame."""
    i = (np.arange(rows) + 0.5) * values.shape[0] / rows
    j = (np.arange(cols) + 0.5) * values.shape[1] / cols
    return values[np.ix_(i.astype(np.int64), j.astype(np.int64))]


def _cell(view: View) -> float:
    return max(max(view.width, view.height) / _CELLS, _LEAST_CELL)


def _frames(images: Sequence[Image], maps: DepthMaps | None) -> Sequence[View]:
    """The images' frames at the size that cells are stated for; with depth maps, those with one."""
    known = [image for image in images if maps is None or image.name in maps]
    return camera_views(known, factor_for_size(known, _MAX_SIZE)) if known else ()


def _depths(
    view: View, xyz: Float32[np.ndarray, "N 3"], maps: DepthMaps | None
) -> Float32[np.ndarray, "rows cols"]:
    """Planar depth of each cell, gaps filled; infinite in all where nothing is known."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  (slow to import)

    if maps is None:
        depths = cell_depths(view.camera, xyz, _cell(view))
    else:  # RGB-D captures have planar depth
        values = _resized(maps.read(view.name).values, *grid_shape(view.camera, _cell(view)))
        depths = np.nan_to_num(values, nan=np.inf)
    known = np.isfinite(depths)
    if known.any() and not known.all():
        k = min(_NEAREST, np.count_nonzero(known))
        _, near = cKDTree(np.argwhere(known)).query(np.argwhere(~known), k=k)
        inverse = 1.0 / depths[known][near.reshape(-1, k)]
        depths = depths.copy()
        depths[~known] = 1.0 / np.median(inverse, axis=1)
    return depths


def _covisible(
    view: View,
    depths: Float32[np.ndarray, "rows cols"],
    seen: Sequence[tuple[View, Float32[np.ndarray, "rows cols"]]],
) -> Bool[np.ndarray, "rows cols"]:
    rows, cols = depths.shape
    known = np.isfinite(depths)
    # The cells' centres at their depths, in the world.
    centers = (np.indices(depths.shape).reshape(2, -1)[::-1] + 0.5).T
    uv = centers * [view.width / cols, view.height / rows]
    xyz = np.asfortranarray(view.camera.unproject(uv, np.where(known, depths, -1.0).ravel()))
    count = np.zeros(rows * cols, np.int32)
    for other, farthest in seen:
        points = points_in_image(other.camera, xyz)
        there = farthest[points.cells(other.camera, farthest.shape)]
        count[points.point_idx] += there >= (1.0 - SURFACE) * points.depth
    return np.asarray((count.reshape(depths.shape) >= _LEAST_VIEWS) & known)


def write_covisible(path: Path, grids: Grids) -> None:
    """Store cells for the next run."""
    names = np.array(list(grids), dtype=np.str_)
    arrays: dict[str, Any] = {f"cells_{i}": grid for i, grid in enumerate(grids.values())}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, names=names, **arrays)


def read_covisible(path: Path) -> dict[str, Bool[np.ndarray, "rows cols"]] | None:
    """The cells that ``write_covisible`` stored; None if the file is missing or unreadable."""
    try:
        with np.load(path, allow_pickle=False) as kept:
            return {str(name): kept[f"cells_{i}"] for i, name in enumerate(kept["names"])}
    except ARCHIVE_FAILURES:
        return None
