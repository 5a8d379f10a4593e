"""Match each view with its sources: a plane per grid point, and the views that confirm it.

Notation: the grid of a view has h x w points, g pixels apart, and planes [3, h, w]: inverse depth w
and its slopes per pixel.

*Initial planes.* A view sees M points at pixels uv [M, 2] with inverse depth w [M], from
Structure-from-Motion or coarse stereo. Each grid point starts with K candidates; where a view sees
too few points, they are inverse depths drawn uniformly from its depth range.

*Confirmation.* Point X at a grid point of view i projects into view j, whose plane at the nearest
grid point has inverse depth w_j there. The views *agree* if |z_ij w_j - 1| <= tolerance, with z_ij
the depth of X in j. Each pair is compared in both directions independently.
Promise: a view's planes depend only on the photographs, its prior and the seed. Each view is
matched by one thread, so results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8
from scipy.spatial import cKDTree

from splatseed.depth.stereo._kernels.agreement import confirm
from splatseed.depth.stereo._kernels.cost import pack_quads, to_grey
from splatseed.depth.stereo._kernels.patchmatch import QuadImages, initialise, red_black_sweep
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.photos.view import View
from splatseed.progress import Progress, in_threads, num_threads
from splatseed.projection import pixel_centers
from splatseed.runtime.memory import check_memory

BYTES_PER_DEPTH = 3 * 4 + 4 + 1
"""A plane, a cost and agreement bits."""

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue, ITU-R BT.601."""

Grey = UInt8[np.ndarray, "H W"]
Matched = tuple[Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w"]]
"""Planes and costs of a view."""


@dataclass(frozen=True)
class _InitialPlanes:
    """Candidates that PatchMatch starts from."""

    num_nearest: int = 3  # nearest points whose depth gives a fronto-parallel plane
    num_fitted: int = 8  # nearest points that a plane is fitted to
    num_random: int = 16  # candidates where a view sees fewer points than that
    margin: float = 1.3  # depth ranges extend beyond the points by this factor
    first_sweep: int = 2  # known planes are perturbed as little as in that sweep of others
    ridge: float = 1e-3  # shrinks slopes, relative to the points' spread: they may be collinear


INITIAL = _InitialPlanes()


@dataclass(frozen=True, eq=False)
class DepthPrior:
    """Known points and depth range of a view before stereo."""

    uv: Float64[np.ndarray, "M 2"]  # pixels of the points that it sees
    w: Float64[np.ndarray, " M"]  # their inverse depths
    bounds: Float32[np.ndarray, " 2"]  # smallest and largest inverse depth of the search
    planes: Float32[np.ndarray, "3 h w"] | None = None  # of an earlier comparison, in view pixels
    step: float = 0.0  # pixels between these planes

    @classmethod
    def from_points(
        cls, uv: Float64[np.ndarray, "M 2"], w: Float64[np.ndarray, " M"]
    ) -> DepthPrior:
        """Prior from at least one point: the range extends a little beyond the points."""
        # Percentiles, as a few of SfM's points float in front of the cameras.
        low, high = np.percentile(w, [0.5, 99.5])
        return cls(uv, w, np.array([low / INITIAL.margin, high * INITIAL.margin], np.float32))

    @classmethod
    def from_range(cls, low: float, high: float) -> DepthPrior:
        """Prior without points, from the smallest and the largest inverse depth."""
        return cls(np.empty((0, 2)), np.empty(0), np.array([low, high], np.float32))


def initial_planes(
    prior: DepthPrior, shape: tuple[int, int], grid: int, rng: np.random.Generator
) -> Float32[np.ndarray, "K 3 h w"]:
    """Candidate planes for each grid point, random where the view sees too few points."""
    rows, columns = shape
    if prior.planes is not None:
        return _nearest_planes(prior.planes, prior.step, shape, grid)
    w = prior.w
    if len(w) < INITIAL.num_fitted:
        low, high = prior.bounds
        planes = np.zeros((INITIAL.num_random, 3, rows, columns), np.float32)
        planes[:, 0] = rng.uniform(low, high, (INITIAL.num_random, rows, columns))
        return planes
    uv = pixel_centers(*shape).reshape(-1, 2) * grid
    nearest = cKDTree(prior.uv).query(uv, INITIAL.num_fitted)[1]
    num = INITIAL.num_nearest
    planes = np.zeros((num + 1, 3, rows * columns), np.float32)
    planes[:num, 0] = w[nearest[:, :num]].T
    planes[num] = _fit_planes(prior.uv[nearest] - uv[:, None], w[nearest])
    return np.ascontiguousarray(planes.reshape(-1, 3, rows, columns))


def _fit_planes(
    offsets: Float64[np.ndarray, "G K 2"], w: Float64[np.ndarray, "G K"]
) -> Float64[np.ndarray, "3 G"]:
    """Fit w + gx du + gy dv to K points each by least squares, with slopes shrunk towards 0."""
    design = np.concatenate([np.ones((*w.shape, 1)), offsets], axis=2)
    normal = np.swapaxes(design, 1, 2) @ design
    spread = np.trace(normal[:, 1:, 1:], axis1=1, axis2=2)
    # Normal equations of w0 + gx du + gy dv; only the slopes are shrunk.
    normal[:, [1, 2], [1, 2]] += INITIAL.ridge * (1.0 + spread)[:, None]
    right = np.swapaxes(design, 1, 2) @ w[..., None]
    fitted = np.linalg.solve(normal, right)[..., 0].T
    low, high = w.min(axis=1), w.max(axis=1)
    # Extrapolated planes can leave the points' range of depth, or end behind the camera.
    outside = (fitted[0] < low / INITIAL.margin) | (fitted[0] > high * INITIAL.margin)
    fitted[:, outside] = [w[outside].mean(axis=1), np.zeros(outside.sum()), np.zeros(outside.sum())]
    return np.asarray(fitted)


def _nearest_planes(
    planes: Float32[np.ndarray, "3 h w"], step: float, shape: tuple[int, int], grid: int
) -> Float32[np.ndarray, "4 3 rows columns"]:
    """Extrapolate the four nearest planes of a coarser grid to each point of a finer one."""
    # Pixel (q + 0.5) grid lies at (q + 0.5) grid / step - 0.5 in units of the coarser grid.
    places = [(np.arange(n) + 0.5) * grid for n in shape]
    cells = [np.floor(place / step - 0.5).astype(np.int64) for place in places]
    out = np.empty((4, 3, *shape), np.float32)
    for k in range(4):
        ends = planes.shape[1:]
        row, column = (
            np.clip(cell + (k >> axis & 1), 0, end - 1)
            for axis, (cell, end) in enumerate(zip(cells, ends, strict=True))
        )
        down, across = (
            (place - (at + 0.5) * step).astype(np.float32)
            for place, at in zip(places, (row, column), strict=True)
        )
        w, gx, gy = planes[:, row[:, None], column]
        # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
        out[k] = w + gx * across + gy * down[:, None], gx, gy
    return out


def check_stereo_memory(views: Sequence[View], settings: StereoSettings) -> None:
    """Refuse photographs whose comparison does not fit into memory.

    Memory holds all grey photographs, the planes at each grid point, and for each thread the quad
    images (4 bytes per pixel) of a view and its sources.
    """
    grid, sizes = settings.grid, [view.width * view.height for view in views]
    depths = sum((view.width // grid) * (view.height // grid) for view in views)
    threads = min(num_threads(), len(views))
    quads = threads * max(sizes) * 4 * (1 + min(settings.num_sources, len(views) - 1))
    check_memory(
        depths,
        BYTES_PER_DEPTH + -(-(sum(sizes) + quads) // max(depths, 1)),
        "depths held at once",
        found=f"{depths:,}, at a grid of {grid} in {len(views)} photographs",
        fix="Choose a larger grid, smaller or fewer photographs, or free some memory.",
    )


def match_views(
    views: Sequence[View],
    priors: Sequence[DepthPrior | None],
    sources: Int64[np.ndarray, "V K"],
    settings: StereoSettings,
    seed: int,
    progress: Progress,
) -> StereoResult:
    """Find planes for each view by PatchMatch, and the sources that confirm them.

    Args:
        views: The photographs.
        priors: What is known of each view's depth; a view with None gets no map.
        sources: The views to compare each with, best first, int64 [V, K]; -1 = none.
        settings: Settings of stereo.
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
            matched[i] = _match_view(i, others, views, greys, priors[i], settings, rng)

    in_threads(work, len(views), 1, "compare photographs", progress)
    planes, costs = [pair[0] for pair in matched], [pair[1] for pair in matched]
    agreeing = _confirm_all(views, planes, costs, sources, settings, progress)
    unknown = np.full(2, np.nan, np.float32)
    bounds = np.stack([unknown if prior is None else prior.bounds for prior in priors])
    return StereoResult(tuple(views), planes, costs, agreeing, sources, bounds, settings)


def _match_view(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    greys: Sequence[Grey],
    prior: DepthPrior | None,
    settings: StereoSettings,
    rng: np.random.Generator,
) -> Matched:
    """Find the planes of view i; NaN with infinite costs without sources or prior."""
    view, grid = views[i], settings.grid
    shape = (view.height // grid, view.width // grid)
    planes, costs = np.full((3, *shape), np.nan, np.float32), np.full(shape, np.inf, np.float32)
    if not others or prior is None or not costs.size:
        return planes, costs
    quad_images = make_quad_images(
        view, greys[i], [views[j] for j in others], [greys[j] for j in others], grid, prior.bounds
    )
    initialise(quad_images, initial_planes(prior, shape, grid, rng), planes, costs)
    first = 0 if prior.planes is None else INITIAL.first_sweep
    for number in range(first, first + settings.sweeps):
        for color in range(2):
            key = rng.integers(1 << 63, dtype=np.uint64)
            red_black_sweep(quad_images, color, number, key, planes, costs)
    if view.surface is not None:
        # Undistortion leaves borders without pixels, where planes are meaningless.
        costs[~valid_blocks(view.surface, grid)] = np.inf
    return planes, costs


def valid_blocks(mask: Bool[np.ndarray, "H W"], grid: int) -> Bool[np.ndarray, "h w"]:
    """Blocks of grid x grid pixels that lie entirely within the mask."""
    rows, columns = mask.shape[0] // grid, mask.shape[1] // grid
    blocks = mask[: rows * grid, : columns * grid].reshape(rows, grid, columns, grid)
    return np.asarray(blocks.all(axis=(1, 3)))


def _confirm_all(
    views: Sequence[View],
    planes: Sequence[Float32[np.ndarray, "3 h w"]],
    costs: Sequence[Float32[np.ndarray, "h w"]],
    sources: Int64[np.ndarray, "V K"],
    settings: StereoSettings,
    progress: Progress,
) -> list[UInt8[np.ndarray, "h w"]]:
    """Set bit k at each pixel of a view whose depth its source k confirms."""
    # A source's map is computed without this view's, so its agreement is evidence.
    agreeing = [np.zeros(cost.shape, np.uint8) for cost in costs]

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


def grey_image(image: UInt8[np.ndarray, "H W 3"]) -> Grey:
    """Luma of sRGB pixels, rounded to 8 bits."""
    out = np.empty(image.shape[:2], np.uint8)
    to_grey(image, LUMA, out)
    return out


def make_quads(grey: Grey) -> Int32[np.ndarray, "H W"]:
    """Quad image of a grey image (see ``_kernels.cost``)."""
    out = np.empty(grey.shape, np.int32)
    pack_quads(grey, out)
    return out


def make_quad_images(
    view: View,
    grey: Grey,
    others: Sequence[View],
    greys: Sequence[Grey],
    grid: int,
    bounds: Float32[np.ndarray, " 2"],
) -> QuadImages:
    """Pack a view and its sources for the kernels.

    Args:
        view: The reference view.
        grey: Its grey image.
        others: Its sources.
        greys: Their grey images.
        grid: Pixels between grid points.
        bounds: Smallest and largest inverse depth.
    """
    offsets = np.cumsum([0, *(image.size for image in greys)])
    sources: Int32[np.ndarray, " Q"] = np.empty(offsets[-1], np.int32)
    for start, stop, image in zip(offsets, offsets[1:], greys, strict=False):
        sources[start:stop] = make_quads(image).ravel()
    warps = [other_from_view(view, other) for other in others]
    packed = [np.concatenate([warp[:, :3].ravel(), warp[:, 3]]) for warp in warps]
    sizes = np.array([(other.width, other.height) for other in others], np.int64)
    return QuadImages(
        make_quads(grey).ravel(), np.array([view.width, view.height], np.int64),
        sources, sizes, offsets, np.array(packed, np.float32), grid, float(view.K[0, 0]), bounds,
    )  # fmt: skip


def other_from_view(view: View, other: View) -> Float64[np.ndarray, "3 4"]:
    """Matrix K_s [R K_r^-1, t] from pixels (u, v, 1) of a view times depth, and 1, to another's."""
    # source from reference: x_s = R x_r + t with x_r = z K_r^-1 (u, v, 1)
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    return np.asarray(
        other.K @ np.hstack([relative[:3, :3] @ np.linalg.inv(view.K), relative[:3, 3:]])
    )
