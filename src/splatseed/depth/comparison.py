"""Views compared with each other: which to ask, a factor for each map, and what others confirm.

*Neighbours.* V views, S sample points of each. A view *covers* a sample of another, with a weight
by the angle between the two cameras' rays to it. Neighbours are chosen one after another, each for
the samples that the ones before cover least.

*Scales.* Depth of view i is multiplied by exp(g_i), so that maps agree where they overlap. A pair
(i, j) that sees the same places has a = median log(d_j / z_ij), where z_ij is the depth in view j
of candidates of view i, and d_j the depth of view j itself there. Promise: the most probable g by
pairs and SfM points together, with Huber's weights; pairs move maps only relative to each other,
and the common scale remains that of the SfM points. Nothing is random. (SfM points of one image err
together: on 7-Scenes red kitchen, where one sensor's scale is the same for all frames, scales
fitted to one image at a time are off by 4%, and by up to 20%.)

*Support.* At a point that falls into another view's frame at planar depth z, that view has its own
depth d at the four grid points around it. The view *confirms* the point if |d - z| <= tolerance z
for one of them and the colours of both views there are close; it *looks through* the point if all
four d are clearly farther. A point behind what the view sees is hidden from it, and nothing
follows. Only reduced copies are read, so no file is opened again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve

from splatseed.depth.alignment import SIGMA_OF_MEDIAN, Settings
from splatseed.depth.views import DepthView, Reduced
from splatseed.photos._kernels import cosine_between, project_point
from splatseed.progress import Progress, in_threads
from splatseed.runtime.jit import inline, kernel, parallel_range

MIN_SAMPLES, SAMPLES = 4, 40
"""Candidates of a view by which its neighbours are judged: the fewer, the more views there are."""
WORK = 1 << 28
"""Limit on projections."""
SHORTLIST = 2
"""Views on the shortlist, per neighbour chosen."""
FULL = 0.03
"""1 - cos of the angle from which on (14 degrees) a view covers fully; up to 60 degrees."""
LEAST = 0.05
"""Weight of rays that coincide."""
SEEN = 0.25
"""A view sees a sample if its own depth there differs by less than this fraction."""
MOST_COLUMNS = 1e6
"""More columns than any grid has."""
PIECE = 8
"""Views per task of a thread."""


def choose_neighbors(
    views: Sequence[DepthView], num: int, progress: Progress
) -> Int64[np.ndarray, "V num"]:
    """The views to ask about each view's points, best first, int64 [V, num]; -1 = no more.

    Views without a reduced copy neither ask nor answer.
    """
    chosen = np.full((len(views), num), -1)
    usable = np.array([i for i, v in enumerate(views) if v.reduced is not None and len(v)], int)
    if len(usable) < 2:
        return chosen
    # V^2 S projections for the shortlist.
    per_view = int(np.clip(WORK // len(usable) ** 2, MIN_SAMPLES, SAMPLES))
    samples = np.full((len(usable), per_view, 3), np.inf, np.float32)  # seen by nobody
    for own, k in zip(samples, usable.tolist(), strict=True):
        own[: len(views[k])] = views[k].samples(per_view)
    grids = [copy for k in usable.tolist() if (copy := views[k].reduced) is not None]
    matrices = np.stack([grid.grid_from_world for grid in grids])
    sizes = np.array([grid.z.shape for grid in grids])
    centers = np.stack([views[k].camera.center for k in usable.tolist()])
    # First a shortlist by frames alone, then ``num`` of it by what each sees according to its map.
    shortlist = np.full((len(usable), SHORTLIST * num), -1)
    _shortlist(samples, matrices, sizes, centers, shortlist)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            listed = shortlist[i][shortlist[i] >= 0]
            covers = np.zeros((len(listed), per_view))
            for row, j in zip(covers, listed.tolist(), strict=True):
                _weigh(samples[i], matrices[j], sizes[j], centers[i], centers[j], row)
                _keep_seen(samples[i], matrices[j], grids[j].z, grids[j].factor, row)
            best = np.full(num, -1)
            _choose(covers, best)
            best = best[best >= 0]
            chosen[usable[i], : len(best)] = usable[listed[best]]

    in_threads(work, len(usable), PIECE, "choose neighbours", progress)
    return chosen


@kernel
def _shortlist(samples, matrices, sizes, centers, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Views whose frames cover the samples of each view."""
    num, per_view = samples.shape[0], samples.shape[1]
    for i in parallel_range(num):
        covers = np.zeros((num, per_view))
        for j in range(num):
            if j != i:
                _weigh(samples[i], matrices[j], sizes[j], centers[i], centers[j], covers[j])
        _choose(covers, out[i])


@inline
def _choose(covers, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Rows one after another by the sum of w / (1 + covered)^2, until none adds anything."""
    covered, worth = np.zeros(covers.shape[1]), np.ones(covers.shape[1])
    free = np.ones(len(covers), np.bool_)
    for k in range(min(len(out), len(covers))):
        best, most = -1, 0.0
        for j in range(len(covers)):
            if free[j]:
                gain = 0.0
                for s in range(covers.shape[1]):
                    gain += covers[j, s] * worth[s]
                if gain > most:
                    best, most = j, gain
        if best < 0:
            break
        out[k] = best
        free[best] = False
        covered += covers[best]
        # A sample that one full neighbour covers is worth a quarter to the next.
        worth = 1.0 / (1.0 + covered) ** 2


@inline
def _weigh(samples, m, size, center, other, out):  # type: ignore[no-untyped-def]  # Numba's types
    """How well a view covers each sample, by frame and angle."""
    for s in range(len(samples)):
        depth, column, row = _nearest(samples[s], m)
        if 0.0 < depth < np.inf and 0 <= column < size[1] and 0 <= row < size[0]:
            out[s] = _angle_weight(samples[s], center, other)


@inline
def _keep_seen(samples, m, z, factor, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Remove samples that are hidden from the view or unknown to it."""
    for s in range(len(samples)):
        if out[s] > 0.0:
            depth, column, row = _nearest(samples[s], m)
            if not abs(factor * z[row, column] / depth - 1.0) < SEEN:
                out[s] = 0.0


@inline
def _nearest(point, m):  # type: ignore[no-untyped-def]  # Numba's types
    """Depth of a point in a view, and the nearest grid point; column -1 if there is none."""
    column, row, depth = project_point(point, m)
    column, row = column + 0.5, row + 0.5
    if not (0.0 <= column < MOST_COLUMNS and 0.0 <= row < MOST_COLUMNS):
        return depth, -1, -1
    return depth, int(column), int(row)


@inline
def _angle_weight(point, first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """Small where the rays coincide, rising to 1, and 0 where they are 90 degrees apart."""
    # From one place a sensor errs alike; from 90 degrees on, the other side of a surface is seen.
    cosine = cosine_between(point, first, second)
    return min(max((1.0 - cosine) / FULL, LEAST), 1.0) * min(max(2.0 * cosine, 0.0), 1.0)


PAIR_SAMPLES = 96
"""Candidates of a view that are compared with each neighbour."""
PAIRS = 6
"""Neighbours that each view is compared with: more do not change the result."""
LEAST_SAMPLES = 12
"""Fewer common samples say nothing about a pair."""
OTHER_SURFACE = 0.25
"""Larger log ratios come from different surfaces."""
LEAST_SIGMA, LEAST_RESIDUAL = 0.005, 0.0005
"""Standard errors of pairs and of SfM clouds are not trusted below this."""
INDEPENDENT = 0.1
"""Fraction of the samples that counts as independent: neighbouring ones err alike."""
HUBER = 1.345
"""Residuals beyond this many sigmas count linearly: 95% efficiency for normal errors."""
ROUNDS = 2
"""Comparisons of all pairs: after the first, maps overlap better."""
STEPS, CONVERGED = 12, 1e-4
"""Most reweightings of a solution, and the change of log factors at which they end: 0.01%."""


def synchronize_scales(
    views: Sequence[DepthView], neighbors: Int64[np.ndarray, "V num"], progress: Progress
) -> Float64[np.ndarray, " V"]:
    """The factor by which to multiply the depth of each view, [V]."""
    residuals = np.array([view.alignment.residual for view in views])
    sigma = np.maximum(np.where(np.isfinite(residuals), residuals, OTHER_SURFACE), LEAST_RESIDUAL)
    neighbors = neighbors[:, :PAIRS]
    # Rows i, j, a, sigma of every pair that overlaps, with the maps multiplied by exp(g).
    g, pairs = np.zeros(len(views)), np.empty((*neighbors.shape, 4))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            samples = views[i].samples(PAIR_SAMPLES, float(np.exp(g[i])))
            for row, j in zip(pairs[i], neighbors[i].tolist(), strict=True):
                other = views[j].reduced if j >= 0 else None
                if other is not None:
                    row[:2], factor = (i, j), other.factor * np.exp(g[j])
                    _compare_pair(samples, other.z, factor, other.grid_from_world, row[2:])

    for _ in range(ROUNDS):  # again from where the first solution leaves the maps
        pairs[:] = np.nan
        in_threads(work, len(views), PIECE, "synchronize scales", progress)
        g = _solve_scales(pairs[np.isfinite(pairs).all(axis=2)], g, sigma)
    return np.asarray(np.exp(g))


def _solve_scales(
    pairs: Float64[np.ndarray, "P 4"],
    before: Float64[np.ndarray, " V"],
    anchor_sigma: Float64[np.ndarray, " V"],
) -> Float64[np.ndarray, " V"]:
    """The most probable g, by iteratively reweighted least squares."""
    num, num_pairs = len(before), len(pairs)
    i, j = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    row = np.arange(num_pairs)
    ones = np.ones(num_pairs)
    rows = np.concatenate([row, row, num_pairs + np.arange(num)])
    columns = np.concatenate([i, j, np.arange(num)])
    values = np.concatenate([-ones, ones, np.ones(num)])
    # To first order g_j - g_i = -a to within the spread of the samples, and, by the SfM points of
    # image i, g_i = 0 to within its residual.
    A = csc_matrix((values, (rows, columns)), shape=(num_pairs + num, num))
    target = np.concatenate([before[j] - before[i] - pairs[:, 2], np.zeros(num)])
    sigma = np.concatenate([pairs[:, 3], anchor_sigma])
    g = before
    for _ in range(STEPS):
        r = np.abs(A @ g - target) / sigma
        weight = np.minimum(1.0, HUBER / np.maximum(r, HUBER)) / sigma**2  # Huber's
        weighted = A.multiply(weight[:, None]).tocsc()
        g, last = np.atleast_1d(spsolve((A.T @ weighted).tocsc(), weighted.T @ target)), g
        if np.abs(g - last).max() < CONVERGED:
            break
    return np.asarray(g)


@inline
def _compare_pair(samples, z, factor, m, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Median a of a pair and its standard error; leaves NaN where too little overlaps."""
    logs = np.empty(len(samples))
    count = 0
    for k in range(len(samples)):
        across, down, depth = project_point(samples[k], m)
        if depth <= 0.0:
            continue
        # The nearest grid point: those lie at whole numbers.
        column, row = int(np.floor(across + 0.5)), int(np.floor(down + 0.5))
        if not (0 <= column < z.shape[1] and 0 <= row < z.shape[0] and z[row, column] > 0):
            continue
        # log d_j / z_ij
        log = np.log(factor * z[row, column] / depth)
        if abs(log) <= OTHER_SURFACE:
            logs[count] = log
            count += 1
    if count >= LEAST_SAMPLES:
        out[0] = np.median(logs[:count])
        # Robust standard error of a median of INDEPENDENT count samples.
        spread = SIGMA_OF_MEDIAN * np.median(np.abs(logs[:count] - out[0]))
        out[1] = max(spread / np.sqrt(INDEPENDENT * count), LEAST_SIGMA)


THROUGH = 2.0
"""Clearly farther: by this many tolerances, as both depths have errors."""

ALWAYS = 8
"""Views asked about every point; more are asked about points that lack confirmation."""

SAYS_NOTHING, CONFIRMS, LOOKS_THROUGH = range(3)


def find_support(
    xyz: Float32[np.ndarray, "C 3"], own: Reduced, others: Sequence[Reduced], settings: Settings
) -> tuple[UInt8[np.ndarray, " C"], Bool[np.ndarray, " C"]]:
    """Compare the candidates of a view, whose reduced copy is ``own``, with other views.

    Returns how many views confirm each, counted up to the number required, and whether some view
    looks through each.
    """
    agreeing = np.zeros(len(xyz), np.uint8)
    seen_through = np.zeros(len(xyz), np.bool_)
    # The sum over three channels of 8 bits.
    limit = np.inf if settings.color_tolerance is None else 3 * 255 * settings.color_tolerance
    rgb = np.empty((len(xyz), 3), np.uint8)
    _own_colors(xyz, own.grid_from_world, own.rgb, own.rgb_from_grid, rgb)
    for rank, other in enumerate(others):
        _ask(
            xyz, rgb, other.z, other.factor, other.grid_from_world, other.rgb, other.rgb_from_grid,
            settings.tolerance, limit, settings.min_agreeing, rank >= ALWAYS, agreeing,
            seen_through,
        )  # fmt: skip
    return agreeing, seen_through


@inline
def _own_colors(xyz, grid_from_world, rgb, rgb_from_grid, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Colours of a view's own reduced photograph at its candidates, as smooth as the others'."""
    for k in range(len(xyz)):
        column, row, _ = project_point(xyz[k], grid_from_world)
        p, q = _block(column, row, rgb_from_grid, rgb.shape)
        for channel in range(3):
            out[k, channel] = rgb[p, q, channel]


@inline
def _ask(  # type: ignore[no-untyped-def]  # Numba's types
    xyz, own, z, factor, grid_from_world, rgb, rgb_from_grid, tolerance, limit, enough,
    only_unconfirmed, agreeing, seen_through,
):  # fmt: skip
    """Add one neighbour's verdict on all candidates."""
    height, width = z.shape
    for k in range(len(xyz)):
        if only_unconfirmed and agreeing[k] >= enough:
            continue
        column, row, depth = project_point(xyz[k], grid_from_world)
        if depth > 0.0 and -0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5:
            # In the map's own units: one division here instead of four multiplications.
            verdict = _compare(z, column, row, depth / factor, tolerance)
            if verdict == LOOKS_THROUGH:
                seen_through[k] = True
            elif verdict == CONFIRMS and agreeing[k] < enough:
                p, q = _block(column, row, rgb_from_grid, rgb.shape)
                agreeing[k] += _color_error(own[k], rgb[p, q]) <= limit


@inline
def _compare(z, column, row, depth, tolerance):  # type: ignore[no-untyped-def]  # Numba's types
    """What the map of a view says about a depth at a grid position; NaN says nothing."""
    x0 = min(max(int(np.floor(column)), 0), max(z.shape[1] - 2, 0))
    y0 = min(max(int(np.floor(row)), 0), max(z.shape[0] - 2, 0))
    x1, y1 = min(x0 + 1, z.shape[1] - 1), min(y0 + 1, z.shape[0] - 1)
    a, b, c, d = z[y0, x0], z[y0, x1], z[y1, x0], z[y1, x1]
    # One agreeing corner confirms; all four must be farther to look through. NaN does neither.
    near = tolerance * depth
    if (
        abs(a - depth) <= near
        or abs(b - depth) <= near
        or abs(c - depth) <= near
        or abs(d - depth) <= near
    ):
        return CONFIRMS
    far = depth + THROUGH * near
    if a > far and b > far and c > far and d > far:
        return LOOKS_THROUGH
    return SAYS_NOTHING


@inline
def _block(column, row, rgb_from_grid, shape):  # type: ignore[no-untyped-def]  # Numba's types
    """Row and column of the reduced photograph at a grid position."""
    p = int(np.floor(row * rgb_from_grid[1, 0] + rgb_from_grid[1, 1]))
    q = int(np.floor(column * rgb_from_grid[0, 0] + rgb_from_grid[0, 1]))
    return min(max(p, 0), shape[0] - 1), min(max(q, 0), shape[1] - 1)


@inline
def _color_error(first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """Sum of the channels' differences."""
    total = np.int64(0)
    for channel in range(3):
        total += abs(np.int64(first[channel]) - np.int64(second[channel]))
    return total
