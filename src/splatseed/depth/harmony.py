"""One factor an image, so that maps agree with one another where they overlap.

Notation: V views; ``log_factor`` g [V] multiplies depth by exp(g). A pair (i, j) of views that see the same
places says: with a = median log(d_j / z_ij), where z_ij is the depth in view j of a candidate of view i and
d_j what view j knows there, and b the median of d log z_ij / d g_i (1 where both look along one line),

    a + g_j = b g_i,   to within the spread of the samples,

and the SfM points of each image say g_i = 0 to within the image's residual. Promise: the most probable g
under these, with Huber's weights; nothing is random.

SfM points of one image err together: on 7-Scenes red kitchen, where one sensor's scale is the same for all
frames, scales fitted to one image at a time are off by 3% typically, and by up to 20%.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve

from splatseed.depth.fits import SIGMA_OF_MEDIAN
from splatseed.depth.views import View
from splatseed.jit import inline
from splatseed.progress import Progress, in_threads

__all__ = ["harmonize"]

SAMPLES = 128
"""Candidates of a view that are looked up in each neighbour."""
LEAST_SAMPLES = 12
FAR = 0.25
"""Logarithms of ratios beyond this are of other surfaces."""
LEAST_SIGMA = 0.005
"""No pair and no SfM cloud is believed to more than this."""
INDEPENDENT = 0.1
"""Share of the samples that is taken to be independent: neighbouring ones err alike."""
HUBER = 1.345
STEPS = 12
CONVERGED = 1e-4
PIECE = 8
"""Views that a thread takes at a time."""


def harmonize(
    views: Sequence[View], neighbors: Int64[np.ndarray, "V num"], progress: Progress
) -> Float64[np.ndarray, " V"]:
    """What to multiply the depth of each view by, [V].

    Args:
        views: Views with reduced copies.
        neighbors: Which views to compare each with, -1 = none.
        progress: Told how many are compared.
    """
    pairs = _compare_all(views, neighbors, progress)
    residuals = np.array([view.alignment.residual for view in views])
    sigma = np.maximum(np.where(np.isfinite(residuals), residuals, FAR), LEAST_SIGMA)
    return np.asarray(np.exp(_solve(pairs, sigma)))


def _compare_all(
    views: Sequence[View], neighbors: Int64[np.ndarray, "V num"], progress: Progress
) -> Float64[np.ndarray, "P 5"]:
    """Rows i, j, a, b, sigma of every pair that overlaps."""
    found = np.full((*neighbors.shape, 5), np.nan)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            samples, center = views[i].samples(SAMPLES), views[i].camera.center
            for k, j in enumerate(neighbors[i].tolist()):
                other = views[j].reduced if j >= 0 else None
                if other is not None:
                    found[i, k, :2] = i, j
                    m, factor = other.grid_from_world, other.factor
                    _compare_pair(samples, center, other.z, factor, m, found[i, k, 2:])

    in_threads(work, len(views), PIECE, "harmonize depth", progress)
    rows = found.reshape(-1, 5)
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _solve(
    pairs: Float64[np.ndarray, "P 5"], anchor_sigma: Float64[np.ndarray, " V"]
) -> Float64[np.ndarray, " V"]:
    """The most probable log factors, by iteratively reweighted least squares."""
    num, num_pairs = len(anchor_sigma), len(pairs)
    i, j = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    row = np.arange(num_pairs)
    values = np.concatenate([pairs[:, 3], -np.ones(num_pairs), np.ones(num)])
    rows = np.concatenate([row, row, num_pairs + np.arange(num)])
    columns = np.concatenate([i, j, np.arange(num)])
    A = csc_matrix((values, (rows, columns)), shape=(num_pairs + num, num))
    target = np.concatenate([pairs[:, 2], np.zeros(num)])
    sigma = np.concatenate([pairs[:, 4], anchor_sigma])
    g = np.zeros(num)
    for _ in range(STEPS):
        r = np.abs(A @ g - target) / sigma
        weight = np.minimum(1.0, HUBER / np.maximum(r, HUBER)) / sigma**2
        weighted = A.multiply(weight[:, None]).tocsc()
        g, before = np.atleast_1d(spsolve((A.T @ weighted).tocsc(), weighted.T @ target)), g
        if np.abs(g - before).max() < CONVERGED:
            break
    return np.asarray(g)


@inline
def _compare_pair(samples, center, z, factor, m, out):  # type: ignore[no-untyped-def]
    """Medians a and b of a pair, and the standard error of a; leaves NaN where too little overlaps."""
    logs, slopes = np.empty(len(samples)), np.empty(len(samples))
    count = 0
    for k in range(len(samples)):
        x, y, w = np.float64(samples[k, 0]), np.float64(samples[k, 1]), np.float64(samples[k, 2])
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * w + m[2, 3]
        if depth <= 0.0:
            continue
        column = int(np.floor((m[0, 0] * x + m[0, 1] * y + m[0, 2] * w + m[0, 3]) / depth + 0.5))
        row = int(np.floor((m[1, 0] * x + m[1, 1] * y + m[1, 2] * w + m[1, 3]) / depth + 0.5))
        if not (0 <= column < z.shape[1] and 0 <= row < z.shape[0] and z[row, column] > 0):
            continue
        log = np.log(factor * z[row, column] / depth)
        if abs(log) <= FAR:
            x, y, w = x - center[0], y - center[1], w - center[2]
            logs[count] = log
            slopes[count] = (m[2, 0] * x + m[2, 1] * y + m[2, 2] * w) / depth
            count += 1
    if count >= LEAST_SAMPLES:
        out[0], out[1] = np.median(logs[:count]), np.median(slopes[:count])
        spread = SIGMA_OF_MEDIAN * np.median(np.abs(logs[:count] - out[0]))
        out[2] = max(spread / np.sqrt(INDEPENDENT * count), LEAST_SIGMA)
