"""Coverage: which cells of the photographs show a point.

Notation: views are divided into the cells of ``photos.zbuffer``; a cell is *covered* if it holds a
point and its neighbours do not hide it, so that its depth is finite.
Promise: results depend neither on the order of the points nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32

from splatseed.errors import ParameterError, PointCloudError
from splatseed.photos.view import View
from splatseed.photos.zbuffer import cell_depths
from splatseed.progress import Progress, in_threads, silent


def covered_share(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    cell: float = 8,
    progress: Progress = silent,
) -> float:
    """Return the mean over views of the fraction of cells, ``cell`` pixels wide, that are covered.

    Views need no pixels.

    Raises:
        ParameterError: There is no view, or ``cell`` is below 1.
        PointCloudError: ``xyz`` is not of shape [N, 3].
    """
    return float(np.mean([cells.mean() for cells in covered_cells(views, xyz, cell, progress)]))


def covered_cells(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    cell: float = 8,
    progress: Progress = silent,
) -> tuple[Bool[np.ndarray, "rows cols"], ...]:
    """Tell which cells of each view are covered; arguments and errors as in ``covered_share``."""
    xyz = check_points(views, xyz, cell)
    depths = cell_depths_of_views(views, xyz, cell, progress, "find uncovered cells")
    return tuple(np.isfinite(cells) for cells in depths)


def cell_depths_of_views(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    cell: float,
    progress: Progress,
    stage: str,
) -> list[Float32[np.ndarray, "rows cols"]]:
    """Compute ``cell_depths`` of each view, on all threads."""
    maps = [np.empty((0, 0), np.float32)] * len(views)

    def work(start: int, _stop: int) -> None:
        maps[start] = cell_depths(views[start].camera, xyz, cell)

    in_threads(work, len(views), 1, stage, progress)
    return maps


def check_points(
    views: Sequence[View], xyz: Float32[np.ndarray, "N 3"], cell: float
) -> Float32[np.ndarray, "N 3"]:
    """Return ``kernel_points``; errors are those of ``covered_share``."""
    if not views:
        raise ParameterError("at least one view", found="none", fix="Pass a scene with images.")
    if not (np.isfinite(cell) and cell >= 1):
        raise ParameterError("a cell of at least 1 pixel", found=f"{cell}", fix="Choose 4 to 16.")
    return kernel_points(xyz)


def kernel_points(xyz: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Return points as kernels need them: float32, contiguous.

    Raises:
        PointCloudError: ``xyz`` is not of shape [N, 3].
    """
    xyz = np.asarray(xyz)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise PointCloudError(
            "xyz of shape [N, 3]", found=f"{list(xyz.shape)}", fix="Pass one row x, y, z per point."
        )
    return np.ascontiguousarray(xyz, np.float32)
