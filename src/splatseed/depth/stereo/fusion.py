"""Fuse the maps of all views to one seed per piece of surface.

Promise: seeds lie on confirmed depths only; the same maps give the same bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from splatseed.depth.stereo._kernels.agreement import occupy_cells
from splatseed.depth.stereo.maps import StereoResult, block_means
from splatseed.depth.stereo.quads import other_from_view
from splatseed.progress import Progress, silent

SAME_DEPTH = 0.03
"""Relative difference of depth up to which two seeds in a cell count as one."""


@dataclass(frozen=True, eq=False)
class StereoSeeds:
    """Points on surfaces.

    Args:
        xyz: World positions, float32 [N, 3].
        rgb: Mean colour of the map pixel in the photograph, uint8 [N, 3].
        normals: World axes, towards the view it comes from, float32 [N, 3].
        sizes: The side of a cell at that depth, scene units, float32 [N].
        confidence: From 0 to 1, float32 [N].
        view_idx: The view it comes from, int32 [N].
    """

    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    normals: Float32[np.ndarray, "N 3"]
    sizes: Float32[np.ndarray, " N"]
    confidence: Float32[np.ndarray, " N"]
    view_idx: Int32[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.xyz)


def fuse(stereo: StereoResult, cell: float, progress: Progress = silent) -> StereoSeeds:
    """Choose seeds from confirmed pixels, about ``cell`` pixels apart in the photographs.

    A pixel becomes a seed unless its cell in its own view, or in one that confirms it, already has
    a seed at that depth. Seeds come view by view, the most confident first.

    Args:
        stereo: The result of stereo.
        cell: Side of a cell in pixels of the views; not below the grid of the maps.
        progress: Called with the stage and the fraction done.
    """
    cell = max(float(cell), float(stereo.settings.grid))
    shapes = np.array(
        [(int(view.height / cell) + 1, int(view.width / cell) + 1) for view in stereo.views]
    )
    offsets = np.cumsum([0, *shapes.prod(axis=1)])
    occupied = np.zeros(offsets[-1], np.float32)
    parts = []
    for i in range(len(stereo.views)):
        chosen = _choose_pixels(stereo, i, cell, occupied, offsets, shapes)
        parts.append(_make_seeds(stereo, i, chosen, cell))
        progress("fuse depths", (i + 1) / len(stereo.views))
    arrays = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(StereoSeeds)
    }
    return StereoSeeds(**arrays)


def _choose_pixels(
    stereo: StereoResult,
    i: int,
    cell: float,
    occupied: Float32[np.ndarray, " C"],
    offsets: Int64[np.ndarray, " V+1"],
    shapes: Int64[np.ndarray, "V 2"],
) -> Int64[np.ndarray, " M"]:
    """Choose the pixels of view i that become seeds; occupies their cells in all views."""
    confidence = stereo.confidence(i).ravel()
    # The most confident pixel takes its cell first; pixels at 0 are not confirmed.
    order = np.argsort(-confidence, kind="stable")[: np.count_nonzero(confidence)]
    others = stereo.sources[i]
    matrices: Float64[np.ndarray, "K 3 4"] = np.zeros((len(others), 3, 4))
    for k, j in enumerate(others.tolist()):
        if j >= 0:
            matrices[k] = other_from_view(stereo.views[i], stereo.views[j])
    chosen = np.zeros(len(order), np.bool_)
    occupy_cells(
        order, stereo.planes[i], stereo.agreeing[i], i, others, matrices, stereo.settings.grid,
        cell, SAME_DEPTH, occupied, offsets, shapes, chosen,
    )  # fmt: skip
    return np.asarray(order[chosen])


def _make_seeds(
    stereo: StereoResult, i: int, chosen: Int64[np.ndarray, " M"], cell: float
) -> StereoSeeds:
    """Seeds at the chosen pixels of view i."""
    view, grid = stereo.views[i], stereo.settings.grid
    width = stereo.costs[i].shape[1]
    row, column = chosen // width, chosen % width
    z = 1.0 / stereo.planes[i][0][row, column].astype(np.float64)
    uv = (np.stack([column, row], axis=1) + 0.5) * grid
    # n' R = (R' n)': from camera axes to the world's.
    normals = stereo.normals(i)[row, column] @ view.cam_from_world[:3, :3]
    return StereoSeeds(
        view.camera.unproject(uv, z).astype(np.float32),
        block_means(view.photograph, grid)[row, column],
        normals.astype(np.float32),
        (cell * z / view.K[0, 0]).astype(np.float32),
        stereo.confidence(i)[row, column],
        np.full(len(chosen), i, np.int32),
    )
