"""Planes for every view, by comparing it with others, and which views confirm them.

Notation: as in ``result``. Promise: a view's planes depend only on the photographs, its hints and
the seed: threads take whole views.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from splatseed.process.memory import check_memory
from splatseed.progress import Progress, in_threads
from splatseed.stereo.consistency import confirm
from splatseed.stereo.patchmatch import QuadImages, begin, sweep
from splatseed.stereo.quads import grey_image, make_quads
from splatseed.stereo.result import StereoResult
from splatseed.stereo.settings import StereoSettings
from splatseed.stereo.start import Hints, first_planes
from splatseed.views.view import View

BYTES_A_DEPTH = 3 * 4 + 4 + 1
"""A view's planes, costs, and agreement bits."""

Matched = tuple[Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w"]]
Grey = UInt8[np.ndarray, "H W"]


def check_stereo_memory(views: Sequence[View], settings: StereoSettings) -> None:
    """Refuse photographs whose comparison does not fit into memory.

    It holds all photographs in grey, the planes at each grid point, and for each thread the quads
    (4 bytes per pixel) of its view and of the views that it is compared with.

    Raises:
        ParameterError: It does not fit.
    """
    grid, sizes = settings.grid, [view.width * view.height for view in views]
    depths = sum((view.width // grid) * (view.height // grid) for view in views)
    threads = min(os.cpu_count() or 1, len(views))
    quads = threads * max(sizes) * 4 * (1 + min(settings.num_sources, len(views) - 1))
    check_memory(
        depths,
        BYTES_A_DEPTH + -(-(sum(sizes) + quads) // max(depths, 1)),
        "depths held at once",
        found=f"{depths:,}, at a grid of {grid} in {len(views)} photographs",
        fix="Choose a larger grid, smaller or fewer photographs, or free some memory.",
    )


def match_views(
    views: Sequence[View],
    hints: Sequence[Hints | None],
    sources: Int64[np.ndarray, "V K"],
    settings: StereoSettings,
    seed: int,
    progress: Progress,
) -> StereoResult:
    """Compare photographs with each other.

    Args:
        views: The photographs.
        hints: What is known of each photograph's depth; one with None gets no map.
        sources: The views to compare each with, best first, int64 [V, K]; -1 = none.
        settings: The choices of stereo.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
    """
    check_stereo_memory(views, settings)
    greys = [grey_image(view.photograph) for view in views]
    matched: list[Matched] = [None] * len(views)  # type: ignore[list-item]  # filled in below

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            others = sources[i][sources[i] >= 0][: settings.num_sources].tolist()
            rng = np.random.default_rng([seed, i])
            matched[i] = _match(i, others, views, greys, hints[i], settings, rng)

    in_threads(work, len(views), 1, "compare photographs", progress)
    planes, costs = [each[0] for each in matched], [each[1] for each in matched]
    agreeing = _confirm_all(views, planes, costs, sources, settings, progress)
    return StereoResult(tuple(views), planes, costs, agreeing, sources, settings)


def _match(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    greys: Sequence[Grey],
    hints: Hints | None,
    settings: StereoSettings,
    rng: np.random.Generator,
) -> Matched:
    """The planes of one view."""
    view, grid = views[i], settings.grid
    shape = (view.height // grid, view.width // grid)
    planes, costs = np.full((3, *shape), np.nan, np.float32), np.full(shape, np.inf, np.float32)
    if not others or hints is None or not costs.size:
        return planes, costs
    quad_images = make_quad_images(
        view, greys[i], [views[j] for j in others], [greys[j] for j in others], grid, hints.bounds
    )
    begin(quad_images, first_planes(hints, shape, grid, rng), planes, costs)
    for number in range(settings.sweeps):
        for color in range(2):
            sweep(quad_images, color, number, rng.integers(1 << 63, dtype=np.uint64), planes, costs)
    if view.mask is not None:
        # Undistortion leaves borders without pixels, whose planes mean nothing.
        costs[~_blocks_known(view.mask, grid)] = np.inf
    return planes, costs


def _blocks_known(mask: Bool[np.ndarray, "H W"], grid: int) -> Bool[np.ndarray, "h w"]:
    """Which blocks of grid x grid pixels lie entirely in the photograph."""
    rows, columns = mask.shape[0] // grid, mask.shape[1] // grid
    blocks = mask[: rows * grid, : columns * grid].reshape(rows, grid, columns, grid)
    return np.asarray(blocks.all(axis=(1, 3)))


def make_quad_images(
    view: View,
    grey: Grey,
    others: Sequence[View],
    greys: Sequence[Grey],
    grid: int,
    bounds: Float32[np.ndarray, " 2"],
) -> QuadImages:
    """A view and its sources, as kernels take them.

    Args:
        view: The reference.
        grey: Its brightness.
        others: Its sources.
        greys: Their brightness.
        grid: Pixels between grid points.
        bounds: Smallest and largest inverse depth that is tried.
    """
    offsets = np.cumsum([0, *(each.size for each in greys)])
    sources: Int32[np.ndarray, " Q"] = np.empty(offsets[-1], np.int32)
    for start, stop, each in zip(offsets, offsets[1:], greys, strict=False):
        sources[start:stop] = make_quads(each).ravel()
    warps = [other_from_view(view, other) for other in others]
    packed = [np.concatenate([warp[:, :3].ravel(), warp[:, 3]]) for warp in warps]
    sizes = np.array([(other.width, other.height) for other in others], np.int64)
    return QuadImages(
        make_quads(grey).ravel(), np.array([view.width, view.height], np.int64),
        sources, sizes, offsets, np.array(packed, np.float32), grid, float(view.K[0, 0]), bounds,
    )  # fmt: skip


def other_from_view(view: View, other: View) -> Float64[np.ndarray, "3 4"]:
    """Maps pixels (u, v, 1) of a view times depth, and 1, to another's: K_s [R K_r^-1, t]."""
    # source from reference: x_s = R x_r + t with x_r = z K_r^-1 (u, v, 1)
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    return np.asarray(
        other.K @ np.hstack([relative[:3, :3] @ np.linalg.inv(view.K), relative[:3, 3:]])
    )


def _confirm_all(
    views: Sequence[View],
    planes: Sequence[Float32[np.ndarray, "3 h w"]],
    costs: Sequence[Float32[np.ndarray, "h w"]],
    sources: Int64[np.ndarray, "V K"],
    settings: StereoSettings,
    progress: Progress,
) -> list[UInt8[np.ndarray, "h w"]]:
    """Which witnesses of each view confirm each of its pixels."""
    # Bit k: the k-th source confirms. Its own map was found without this view's.
    agreeing = [np.zeros(each.shape, np.uint8) for each in costs]

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            for bit, j in enumerate(sources[i].tolist()):
                if j >= 0:
                    confirm(
                        planes[i], costs[i], settings.max_cost, settings.grid,
                        other_from_view(views[i], views[j]), planes[j], costs[j],
                        settings.tolerance, np.uint8(1 << bit), agreeing[i],
                    )  # fmt: skip

    in_threads(work, len(views), 4, "compare depths", progress)
    return agreeing
