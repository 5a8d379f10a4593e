"""Planes for every view, by comparing it with others, and which views confirm them.

*Start.* A view sees M Structure-from-Motion points at pixels uv [M, 2] with inverse depth w [M];
the grid has h x w points. There are K guesses per grid point, finite and positive; if a view sees
too few points, they are inverse depths drawn uniformly between the bounds.

*Confirmation.* View i has planes [3, h, w] on its grid; point X at one of its grid points falls on
the grid of view j at (column, row), where j's own plane at the nearest grid point says inverse
depth w_j. Both *agree* if |z_ij w_j - 1| <= tolerance, z_ij the depth of X in j. Every pair is
compared in one direction at a time, so the order of views is irrelevant.
Promise: a view's planes depend only on the photographs, its hints and the seed: threads take whole
views.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8
from scipy.spatial import cKDTree

from splatseed.depth.stereo.cost import grey_image, make_quads
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.depth.stereo.patchmatch import QuadImages, begin, sweep
from splatseed.photos.view import View
from splatseed.progress import Progress, in_threads
from splatseed.runtime.jit import inline
from splatseed.runtime.memory import check_memory

NEAREST = 3
"""Points whose depth is tried as a fronto-parallel plane."""
FITTED = 8
"""Points that a plane is fitted through."""
RANDOM = 16
"""Guesses where nothing is known."""
MARGIN = 1.3
"""Bounds reach this many times beyond the nearest and the farthest point."""
RIDGE = 1e-3
"""Shrinks slopes, relative to the spread of the points: a few in a line do not determine them."""


@dataclass(frozen=True, eq=False)
class Hints:
    """What is known about the depth in a view before stereo."""

    uv: Float64[np.ndarray, "M 2"]  # pixels of points that it sees
    w: Float64[np.ndarray, " M"]  # their inverse depths
    bounds: Float32[np.ndarray, " 2"]  # smallest and largest inverse depth that is searched


def hints_from(uv: Float64[np.ndarray, "M 2"], w: Float64[np.ndarray, " M"]) -> Hints:
    """Hints from at least one point: planes are searched a little beyond the points."""
    # Percentiles, as a few of SfM's points float in front of the cameras.
    low, high = np.percentile(w, [0.5, 99.5])
    return Hints(uv, w, np.array([low / MARGIN, high * MARGIN], np.float32))


def first_planes(
    hints: Hints, shape: tuple[int, int], grid: int, rng: np.random.Generator
) -> Float32[np.ndarray, "K 3 h w"]:
    """The planes to try first at each grid point, random where too few points are seen."""
    rows, columns = shape
    w = hints.w
    if len(w) < FITTED:
        guesses = np.zeros((RANDOM, 3, rows, columns), np.float32)
        guesses[:, 0] = rng.uniform(hints.bounds[0], hints.bounds[1], (RANDOM, rows, columns))
        return guesses
    place = (np.indices(shape)[::-1].reshape(2, -1).T + 0.5) * grid
    nearest = cKDTree(hints.uv).query(place, FITTED)[1]
    guesses = np.zeros((NEAREST + 1, 3, rows * columns), np.float32)
    guesses[:NEAREST, 0] = w[nearest[:, :NEAREST]].T
    guesses[NEAREST] = _fit(hints.uv[nearest] - place[:, None], w[nearest])
    return np.ascontiguousarray(guesses.reshape(-1, 3, rows, columns))


def _fit(
    apart: Float64[np.ndarray, "G K 2"], w: Float64[np.ndarray, "G K"]
) -> Float64[np.ndarray, "3 G"]:
    """Least-squares w + gx du + gy dv through K points each, slopes shrunk a little to 0."""
    design = np.concatenate([np.ones((*w.shape, 1)), apart], axis=2)
    normal = np.swapaxes(design, 1, 2) @ design
    spread = np.trace(normal[:, 1:, 1:], axis1=1, axis2=2)
    # Normal equations of w0 + gx du + gy dv; only the slopes are shrunk.
    normal[:, [1, 2], [1, 2]] += RIDGE * (1.0 + spread)[:, None]
    right = np.swapaxes(design, 1, 2) @ w[..., None]
    fitted = np.linalg.solve(normal, right)[..., 0].T
    low, high = w.min(axis=1), w.max(axis=1)
    # Extrapolated planes can leave the points' depths, or end behind the camera.
    outside = (fitted[0] < low / MARGIN) | (fitted[0] > high * MARGIN)
    fitted[:, outside] = [w[outside].mean(axis=1), np.zeros(outside.sum()), np.zeros(outside.sum())]
    return np.asarray(fitted)


@inline
def confirm(  # type: ignore[no-untyped-def]  # Numba\'s types
    planes, costs, max_cost, grid, j_from_i, other_planes, other_costs, tolerance, bit, out
):
    """Set a bit where another view's map agrees with a view's.

    ``planes`` [3, h, w] and ``costs`` [h, w] are float32, ``out`` uint8 [h, w]; planes above
    ``max_cost`` neither ask nor answer; ``j_from_i`` [3, 4] is ``other_from_view``'s.
    """
    height, width = costs.shape
    m = j_from_i
    for row in range(height):
        for column in range(width):
            if costs[row, column] > max_cost:
                continue
            # X at depth z on the pixel's ray, and its depth and pixel in the other view.
            z = 1.0 / planes[0, row, column]
            u, v = (column + 0.5) * grid * z, (row + 0.5) * grid * z
            depth = m[2, 0] * u + m[2, 1] * v + m[2, 2] * z + m[2, 3]
            if not depth > 0.0:
                continue
            x = (m[0, 0] * u + m[0, 1] * v + m[0, 2] * z + m[0, 3]) / depth
            y = (m[1, 0] * u + m[1, 1] * v + m[1, 2] * z + m[1, 3]) / depth
            if _agrees(x, y, depth, grid, other_planes, other_costs, max_cost, tolerance):
                out[row, column] |= bit


@inline
def _agrees(x, y, depth, grid, planes, costs, max_cost, tolerance):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether a map has this depth at pixel (x, y)."""
    rows, columns = costs.shape
    if not (0.0 <= x < columns * grid and 0.0 <= y < rows * grid):
        return False
    # The nearest grid point: (p, q) lies at pixel ((q + 0.5) g, (p + 0.5) g).
    q, p = int(x / grid), int(y / grid)
    if costs[p, q] > max_cost:
        return False
    # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
    across, down = x - (q + 0.5) * grid, y - (p + 0.5) * grid
    w = planes[0, p, q] + planes[1, p, q] * across + planes[2, p, q] * down
    # |z_ij w_j - 1|: a relative difference of depth, with one multiplication.
    return abs(depth * w - 1.0) <= tolerance


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
        costs[~blocks_known(view.mask, grid)] = np.inf
    return planes, costs


def blocks_known(mask: Bool[np.ndarray, "H W"], grid: int) -> Bool[np.ndarray, "h w"]:
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
