"""One seed for each piece of surface, from the depth maps of all views.

Notation: every view's photograph is divided into cells of c x c pixels. A kept pixel of view i
becomes a seed unless its cell in view i, or in a view that confirms it, already has a seed at that
depth. Promise: seeds come in the order of the views and, within one, of falling confidence,
whatever the number of threads; no two of them share a cell at one depth, in a view that confirms
either.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from splatseed.depth.stereo.maps import StereoResult
from splatseed.depth.stereo.matching import other_from_view
from splatseed.progress import Progress, silent
from splatseed.runtime.jit import inline

SAME = 0.03
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
    """Seeds ``cell`` pixels apart in the photographs.

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
    # The depth of the seed in each cell of each view; 0 is free, as 0 / depth is far from 1.
    taken = np.zeros(offsets[-1], np.float32)
    parts = []
    for i in range(len(stereo.views)):
        chosen = _choose(stereo, i, cell, taken, offsets, shapes)
        parts.append(_seeds(stereo, i, chosen, cell))
        progress("fuse depths", (i + 1) / len(stereo.views))
    fields = StereoSeeds.__dataclass_fields__
    return StereoSeeds(**{f: np.concatenate([getattr(part, f) for part in parts]) for f in fields})


def _choose(
    stereo: StereoResult,
    i: int,
    cell: float,
    taken: Float32[np.ndarray, " C"],
    offsets: Int64[np.ndarray, " V+1"],
    shapes: Int64[np.ndarray, "V 2"],
) -> Int64[np.ndarray, " M"]:
    """The pixels of a view that become seeds.

    Their cells are marked in all views that confirm them.
    """
    confidence = stereo.confidence(i).ravel()
    # The most confident pixel takes its cell first; those at 0 are not kept at all.
    order = np.argsort(-confidence, kind="stable")[: np.count_nonzero(confidence)]
    others = stereo.sources[i]
    matrices: Float64[np.ndarray, "K 3 4"] = np.zeros((len(others), 3, 4))
    for k, j in enumerate(others.tolist()):
        if j >= 0:
            matrices[k] = other_from_view(stereo.views[i], stereo.views[j])
    good = np.zeros(len(order), np.bool_)
    _take(
        order, stereo.planes[i], stereo.agreeing[i], i, others, matrices,
        stereo.settings.grid, cell, taken, offsets, shapes, good,
    )  # fmt: skip
    return np.asarray(order[good])


@inline
def _take(order, planes, agreeing, own, others, matrices, grid, cell, taken, offsets, shapes, good):
    """Mark the cells of a view's pixels, one after another."""
    width = agreeing.shape[1]
    num = len(others)
    places, depths = np.zeros(num + 1, np.int64), np.zeros(num + 1, np.float32)
    for n in range(len(order)):
        row, column = order[n] // width, order[n] % width
        w = planes[0, row, column]
        u, v = (column + 0.5) * grid, (row + 0.5) * grid
        places[0], depths[0] = offsets[own] + int(v / cell) * shapes[own, 1] + int(u / cell), w
        count = 1
        for k in range(num):
            # Its cell in each view that confirms it: the same surface must not get two seeds.
            if agreeing[row, column] >> np.uint8(k) & 1:
                m, j, z = matrices[k], others[k], 1.0 / w
                depth = (m[2, 0] * u + m[2, 1] * v + m[2, 2]) * z + m[2, 3]
                x = ((m[0, 0] * u + m[0, 1] * v + m[0, 2]) * z + m[0, 3]) / depth
                y = ((m[1, 0] * u + m[1, 1] * v + m[1, 2]) * z + m[1, 3]) / depth
                places[count] = offsets[j] + int(y / cell) * shapes[j, 1] + int(x / cell)
                depths[count] = 1.0 / depth
                count += 1
        free = True
        for k in range(count):
            free = free and not abs(taken[places[k]] / depths[k] - 1.0) <= SAME
        if free:
            good[n] = True
            for k in range(count):
                taken[places[k]] = depths[k]


def _seeds(
    stereo: StereoResult, i: int, chosen: Int64[np.ndarray, " M"], cell: float
) -> StereoSeeds:
    """The seeds at some of a view's pixels."""
    view, grid = stereo.views[i], stereo.settings.grid
    width = stereo.costs[i].shape[1]
    row, column = chosen // width, chosen % width
    z = 1.0 / stereo.planes[i][0][row, column].astype(np.float64)
    uv = (np.stack([column, row], axis=1) + 0.5) * grid
    camera = view.camera
    # n' R = (R' n)': from camera axes to the world's.
    normals = stereo.normals(i)[row, column] @ view.cam_from_world[:3, :3]
    return StereoSeeds(
        camera.unproject(uv, z).astype(np.float32),
        block_means(view.photograph, grid)[row, column],
        normals.astype(np.float32),
        (cell * z / view.K[0, 0]).astype(np.float32),
        stereo.confidence(i)[row, column],
        np.full(len(chosen), i, np.int32),
    )


def block_means(image: UInt8[np.ndarray, "H W C"], grid: int) -> UInt8[np.ndarray, "h w C"]:
    """The mean of each block of grid x grid pixels."""
    rows, columns = image.shape[0] // grid, image.shape[1] // grid
    blocks = image[: rows * grid, : columns * grid].reshape(rows, grid, columns, grid, -1)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), np.uint8)
