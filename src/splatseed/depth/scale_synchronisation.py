"""Scale synchronisation: one factor per image, so that maps agree where they overlap.

Notation: V views; depth of view i is multiplied by exp(g_i). A pair (i, j) that sees the same
places has a = median log(d_j / z_ij), where z_ij is the depth in view j of candidates of view i,
and d_j the depth of view j itself there. Promise: the most probable g by pairs and SfM points
together, with Huber's weights. Pairs move maps only relative to each other: the common scale
remains that of the SfM points. Nothing is random.

SfM points of one image err together: on 7-Scenes red kitchen, where one sensor's scale is the same
for all frames, scales fitted to one image at a time are off by 4% (standard deviation), and by up
to 20%.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve

from splatseed.depth.fits import SIGMA_OF_MEDIAN
from splatseed.depth.views import View
from splatseed.kernels.jit import inline
from splatseed.progress import Progress, in_threads
from splatseed.views.projection import place

SAMPLES = 96
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
STEPS = 12
"""Most reweightings of a solution."""
CONVERGED = 1e-4
"""Largest change of a log factor at which reweighting ends: 0.01% of depth."""
PIECE = 8
"""Views per task of a thread."""


def synchronize_scales(
    views: Sequence[View], neighbors: Int64[np.ndarray, "V num"], progress: Progress
) -> Float64[np.ndarray, " V"]:
    """The factor by which to multiply the depth of each view, [V].

    Args:
        views: Views with reduced copies.
        neighbors: Which views to compare each with, -1 = none.
        progress: Called with the stage and the fraction done.
    """
    residuals = np.array([view.alignment.residual for view in views])
    sigma = np.maximum(np.where(np.isfinite(residuals), residuals, OTHER_SURFACE), LEAST_RESIDUAL)
    g = np.zeros(len(views))
    for _ in range(ROUNDS):  # again from where the first solution leaves the maps
        g = _solve(_compare_all(views, neighbors, g, progress), g, sigma)
    return np.asarray(np.exp(g))


def _compare_all(
    views: Sequence[View],
    neighbors: Int64[np.ndarray, "V num"],
    g: Float64[np.ndarray, " V"],
    progress: Progress,
) -> Float64[np.ndarray, "P 4"]:
    """Rows i, j, a, sigma of every pair that overlaps, with the maps multiplied by exp(g)."""
    neighbors = neighbors[:, :PAIRS]
    pairs = np.full((*neighbors.shape, 4), np.nan)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            samples = views[i].samples(SAMPLES, float(np.exp(g[i])))
            for k, j in enumerate(neighbors[i].tolist()):
                other = views[j].reduced if j >= 0 else None
                if other is not None:
                    pairs[i, k, :2] = i, j
                    factor = other.factor * np.exp(g[j])
                    _compare_pair(samples, other.z, factor, other.grid_from_world, pairs[i, k, 2:])

    in_threads(work, len(views), PIECE, "synchronize scales", progress)
    rows = pairs.reshape(-1, 4)
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _solve(
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
        across, down, depth = place(samples[k], m)
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
