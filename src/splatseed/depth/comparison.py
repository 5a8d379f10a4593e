"""Compare views: choose neighbours, synchronise scales, and find support for candidates.

*Neighbours.* V views have S sample points each. A view *covers* a sample of another, with a weight
by the angle between the two cameras' rays to it. Neighbours are chosen greedily, each for the
samples that the previous ones cover least.

*Scales.* Depth of view i is multiplied by exp(g_i) so that maps agree where they overlap. A pair
(i, j) that sees the same surface has a = median log(d_j / z_ij), where z_ij is the depth in view j
of candidates of view i, and d_j the depth of view j itself there. Promise: g is the most probable
by pairs and SfM points together, with Huber's weights; pairs move maps only relative to each other,
and the common scale remains that of the SfM points. Nothing is random. (Scales fitted to one
image's SfM points have a common error per image: on 7-Scenes red kitchen, where one sensor's scale
is the same for all frames, they are off by 4%, and by up to 20%.)

*Support.* A candidate projects into another view at planar depth z, where that view has its own
depth d at the four grid points around it. The view *confirms* the candidate if |d - z| <= tolerance
z at one of them and the colours of both views are close there; it *sees through* the candidate if
all four d are clearly farther. A candidate behind the view's surface is occluded, which decides
nothing. Only reduced copies are read, so no file is opened again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import spsolve

from splatseed.depth._kernels import (
    MAX_LOG_RATIO,
    add_support,
    choose_covering,
    compare_pair,
    drop_occluded,
    frame_weights,
    own_colors,
    shortlist_views,
)
from splatseed.depth.settings import DepthSettings
from splatseed.depth.views import DepthView, Reduced
from splatseed.frozen import read_only_view
from splatseed.progress import Progress, in_threads

VIEWS_PER_TASK = 8
ALWAYS_COMPARED = 8
"""Neighbours compared with every candidate; the rest only with those that lack confirmation."""


@dataclass(frozen=True)
class _NeighborChoice:
    """Choice of neighbours."""

    min_samples: int = 4  # candidates of a view by which its neighbours are chosen
    max_samples: int = 40
    max_projections: int = 1 << 28  # of all samples into all views
    shortlist_factor: int = 2  # views on the shortlist, per neighbour chosen


@dataclass(frozen=True)
class _ScaleFit:
    """Fit of the scales of all maps to each other."""

    num_samples: int = 96  # candidates of a view that are compared with each neighbour
    max_neighbors: int = 6  # more do not change the result
    min_residual: float = 0.0005  # smallest residual of an alignment that is trusted
    huber: float = 1.345  # residuals beyond this many sigmas count linearly: 95% efficiency
    num_rounds: int = 2  # comparisons of all pairs: after the first, maps overlap better
    max_steps: int = 12  # of reweighting
    converged: float = 1e-4  # change of log factors at which reweighting ends: 0.01%


CHOICE, FIT = _NeighborChoice(), _ScaleFit()


def choose_neighbors(
    views: Sequence[DepthView], num: int, progress: Progress
) -> Int64[np.ndarray, "V num"]:
    """Choose the views to compare each view with, best first, int64 [V, num]; -1 = no more.

    Views without a reduced copy are neither compared nor chosen.
    """
    chosen = np.full((len(views), num), -1)
    usable = np.array([i for i, v in enumerate(views) if v.reduced is not None and len(v)], int)
    if len(usable) < 2:
        return chosen
    # V^2 S projections for the shortlist.
    per_view = CHOICE.max_projections // len(usable) ** 2
    per_view = int(np.clip(per_view, CHOICE.min_samples, CHOICE.max_samples))
    samples = np.full((len(usable), per_view, 3), np.inf, np.float32)  # beyond every view
    for own, k in zip(samples, usable.tolist(), strict=True):
        own[: len(views[k])] = views[k].samples(per_view)
    grids = [copy for k in usable.tolist() if (copy := views[k].reduced) is not None]
    matrices = np.stack([grid.grid_from_world for grid in grids])
    sizes = np.array([grid.z.shape for grid in grids])
    centers = np.stack([views[k].camera.center for k in usable.tolist()])
    # A shortlist by frames alone, then ``num`` of it with occlusion by each view's map.
    shortlist = np.full((len(usable), CHOICE.shortlist_factor * num), -1)
    shortlist_views(samples, matrices, sizes, centers, shortlist)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            listed = shortlist[i][shortlist[i] >= 0]
            covers = np.zeros((len(listed), per_view))
            for row, j in zip(covers, listed.tolist(), strict=True):
                frame_weights(samples[i], matrices[j], sizes[j], centers[i], centers[j], row)
                drop_occluded(samples[i], matrices[j], grids[j].z, grids[j].factor, row)
            best = np.full(num, -1)
            choose_covering(covers, best)
            best = best[best >= 0]
            chosen[usable[i], : len(best)] = usable[listed[best]]

    in_threads(work, len(usable), VIEWS_PER_TASK, "choose neighbours", progress)
    return chosen


def synchronize_scales(
    views: Sequence[DepthView], neighbors: Int64[np.ndarray, "V num"], progress: Progress
) -> Float64[np.ndarray, " V"]:
    """Find the factor that multiplies the depth of each view, float64 [V]."""
    residuals = np.array([view.alignment.residual for view in views])
    residuals = np.where(np.isfinite(residuals), residuals, MAX_LOG_RATIO)
    sigma = np.maximum(residuals, FIT.min_residual)
    neighbors = neighbors[:, : FIT.max_neighbors]
    # Rows i, j, a, sigma of each pair that overlaps, with the maps multiplied by exp(g).
    g, pairs = np.zeros(len(views)), np.empty((*neighbors.shape, 4))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            samples = views[i].samples(FIT.num_samples, float(np.exp(g[i])))
            for row, j in zip(pairs[i], neighbors[i].tolist(), strict=True):
                other = views[j].reduced if j >= 0 else None
                if other is not None:
                    row[:2], factor = (i, j), other.factor * np.exp(g[j])
                    compare_pair(samples, other.z, factor, other.grid_from_world, row[2:])

    for _ in range(FIT.num_rounds):
        pairs[:] = np.nan
        in_threads(work, len(views), VIEWS_PER_TASK, "synchronize scales", progress)
        g = _solve_scales(pairs[np.isfinite(pairs).all(axis=2)], g, sigma)
    return np.asarray(np.exp(g))


def _solve_scales(
    pairs: Float64[np.ndarray, "P 4"],
    before: Float64[np.ndarray, " V"],
    anchor_sigma: Float64[np.ndarray, " V"],
) -> Float64[np.ndarray, " V"]:
    """Solve for the most probable g by iteratively reweighted least squares.

    Args:
        pairs: Rows i, j, a, sigma.
        before: g at which the pairs were compared.
        anchor_sigma: Standard error of each map's scale by its SfM points.
    """
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
    for _ in range(FIT.max_steps):
        r = np.abs(A @ g - target) / sigma
        weight = np.minimum(1.0, FIT.huber / np.maximum(r, FIT.huber)) / sigma**2
        weighted = A.multiply(weight[:, None]).tocsc()
        g, last = np.atleast_1d(spsolve((A.T @ weighted).tocsc(), weighted.T @ target)), g
        if np.abs(g - last).max() < FIT.converged:
            break
    return np.asarray(g)


def find_support(
    xyz: Float32[np.ndarray, "C 3"],
    own: Reduced,
    others: Sequence[Reduced],
    settings: DepthSettings,
) -> tuple[UInt8[np.ndarray, " C"], Bool[np.ndarray, " C"]]:
    """Compare the candidates of a view, whose reduced copy is ``own``, with other views.

    Returns:
        The number of views that confirm each, counted up to ``settings.min_agreeing``, and whether
        a view sees through each.
    """
    agreeing = np.zeros(len(xyz), np.uint8)
    seen_through = np.zeros(len(xyz), np.bool_)
    # The sum over three channels of 8 bits.
    limit = np.inf if settings.color_tolerance is None else 3 * 255 * settings.color_tolerance
    rgb = np.empty((len(xyz), 3), np.uint8)
    own_colors(xyz, own.grid_from_world, read_only_view(own.rgb), own.rgb_from_grid, rgb)
    for rank, other in enumerate(others):
        add_support(
            xyz, rgb, other.z, other.factor, other.grid_from_world,
            read_only_view(other.rgb), other.rgb_from_grid, settings.tolerance, limit,
            settings.min_agreeing, rank >= ALWAYS_COMPARED, agreeing, seen_through,
        )  # fmt: skip
    return agreeing, seen_through
