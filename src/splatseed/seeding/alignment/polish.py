"""The last stage of an alignment: exact marks count more, on planes fitted to the cloud.

Notation: a mark p, with covariance C in its own frame, goes to q = s R p + t. Its *patch* is the
plane through the ``NEIGHBORS`` cloud points around the nearest one: their mean m, normal n, and
thickness e, their root mean square distance from it. The residual r = n . (q - m) has the variance
v = n^T (s R) C (s R)^T n + e^2 + f^2, with a floor f for what no model holds. Each round minimises
sum w r^2 with w = T(r / (c k sqrt(v))) T(r / reach) / v: Tukey's weights T, c = ``TUKEY``, and k
the median ratio of residuals to sqrt(v), so that only the ratios of the variances matter. Patches
over edges, whose mean lies off the surface, are left out.
Promise: the covariance is the robust one ("sandwich": Huber 1967; by clusters, Liang and Zeger
1986), H^-1 (sum over cells of g g^T) H^-1 with g = sum w r a over the marks of a cell and a their
rows: it holds whatever the variances are, and marks beside each other may err alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatseed.seeding.alignment.icp import LEAST, Fitted, Surface, design, moved, residuals_of
from splatseed.seeding.alignment.marks import Marks
from splatseed.similarity import Similarity

NEIGHBORS = 20
FLAT = 0.1
"""Greatest thickness of a patch, over its narrower extent; half of the patches always pass, so that
noisy clouds keep theirs."""
FLOOR = 0.0005
"""f, in the scene's units."""
TUKEY = 4.685
"""Loses 5% of the precision of least squares where errors are normal."""
NORMAL_MEDIAN = 0.6745
"""Median absolute deviation of a normal distribution, in standard deviations."""
EXACT = 1e-3
"""Least k: marks without any error would not count at all."""
ROUNDS, STEPS = 4, 12
CELL = 0.1
"""Side of the cells in which errors may be alike, in the scene's units."""


@dataclass(frozen=True, eq=False)
class Polished:
    """An alignment after the last stage.

    Args:
        fitted: The alignment and its covariance.
        sway: Rotation by which it would be off were all principal points off by a pixel in x, or in
            y, radians, float64 [3, 2].
    """

    fitted: Fitted
    sway: Float64[np.ndarray, "3 2"]


class _Patches(NamedTuple):
    """Planes for some marks."""

    mean: Float64[np.ndarray, "M 3"]
    normal: Float64[np.ndarray, "M 3"]
    thickness: Float64[np.ndarray, " M"]
    radius: Float64[np.ndarray, " M"]
    flat: Bool[np.ndarray, " M"]


class _Problem(NamedTuple):
    """Weighted least squares at an alignment; ``used`` tells the marks that count."""

    center: Float64[np.ndarray, " 3"]
    A: Float64[np.ndarray, "m 7"]
    weight: Float64[np.ndarray, " m"]
    off: Float64[np.ndarray, " m"]
    used: Bool[np.ndarray, " M"]

    @property
    def normal(self) -> Float64[np.ndarray, "7 7"]:
        return np.asarray((self.A * self.weight[:, None]).T @ self.A)


def polish(surface: Surface, marks: Marks, start: Similarity, reach: float) -> Polished | None:
    """Make an alignment that is nearly right as exact as the marks allow.

    Args:
        surface: The cloud.
        marks: In the frame of the alignment, with their root mean square distance as unit.
        start: ``cloud_from_scene``, right to a part of the reach.
        reach: Residuals beyond it do not count, in the scene's units.

    Returns:
        The alignment; None where too few marks lie on flat parts of the cloud.
    """
    similarity = start
    for _ in range(ROUNDS):
        patches = _patches(surface, similarity.points(marks.xyz))
        for _ in range(STEPS):
            problem = _problem(patches, marks, similarity, reach)
            step = None if problem is None else _solve(problem)
            if problem is None or step is None:
                return None
            similarity = moved(similarity, problem.center, step)
    return _result(surface, marks, similarity, patches, reach)


def _patches(surface: Surface, q: Float64[np.ndarray, "M 3"]) -> _Patches:
    nearest = surface.tree.query(q)[1]
    around = surface.tree.query(surface.xyz[nearest], min(NEIGHBORS, len(surface.xyz)))[1]
    points = surface.xyz[around]
    mean = points.mean(axis=1)
    centred = points - mean[:, None]
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred) / points.shape[1])
    thickness, width = np.sqrt(np.maximum(spread[:, :2].T, 0.0))
    ratio = thickness / np.maximum(width, np.finfo(float).tiny)
    radius = np.linalg.norm(centred, axis=2).max(axis=1)
    flat = ratio <= max(FLAT, float(np.median(ratio)))
    return _Patches(mean, axes[:, :, 0], thickness, radius, flat)


def _problem(
    patches: _Patches, marks: Marks, similarity: Similarity, reach: float
) -> _Problem | None:
    """The problem of a round; None if too few marks count."""
    q, limit = similarity.points(marks.xyz), reach * similarity.scale
    away = q - patches.mean
    off = np.einsum("ij,ij->i", patches.normal, away)
    beside = np.linalg.norm(away - off[:, None] * patches.normal, axis=1)
    near = patches.flat & (beside < patches.radius) & (np.abs(off) < limit)
    if np.count_nonzero(near) < LEAST:
        return None
    turned = similarity.scale * patches.normal @ similarity.rotation
    variance = np.einsum("ni,nij,nj->n", turned, marks.covariance, turned)
    variance += patches.thickness**2 + (FLOOR * similarity.scale) ** 2
    ratio = off / np.sqrt(variance)
    typical = max(float(np.median(np.abs(ratio[near]))) / NORMAL_MEDIAN, EXACT)
    weight = np.where(near, _tukey(ratio / (TUKEY * typical)) * _tukey(off / limit) / variance, 0.0)
    used = weight > 0
    if np.count_nonzero(used) < LEAST:
        return None
    center = np.average(q[used], axis=0, weights=weight[used])
    A = design(q[used] - center, patches.normal[used])
    return _Problem(center, A, weight[used], off[used], used)


def _tukey(u: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    return np.asarray((1 - np.minimum(np.abs(u), 1.0) ** 2) ** 2)


def _solve(problem: _Problem) -> Float64[np.ndarray, " 7"] | None:
    """The step of a round; None where nothing holds the marks."""
    try:
        step = np.linalg.solve(problem.normal, -problem.A.T @ (problem.weight * problem.off))
    except np.linalg.LinAlgError:
        return None
    return np.asarray(step)


def clustered_covariance(
    A: Float64[np.ndarray, "m k"],
    weight: Float64[np.ndarray, " m"],
    off: Float64[np.ndarray, " m"],
    cells: Int64[np.ndarray, " m"],
) -> Float64[np.ndarray, "k k"]:
    """Covariance of weighted least squares whose errors are alike within cells only.

    Args:
        A: Rows of the unknowns.
        weight: Of each row.
        off: Residuals.
        cells: The cell of each row, from 0.

    Raises:
        numpy.linalg.LinAlgError: The rows do not hold the unknowns.
    """
    scores = np.zeros((int(cells.max()) + 1, A.shape[1]))
    np.add.at(scores, cells, A * (weight * off)[:, None])
    bread = np.linalg.inv((A * weight[:, None]).T @ A)
    return np.asarray(bread @ (scores.T @ scores) @ bread)


def _result(
    surface: Surface, marks: Marks, similarity: Similarity, patches: _Patches, reach: float
) -> Polished | None:
    problem = _problem(patches, marks, similarity, reach)
    if problem is None:
        return None
    places = np.floor(marks.xyz[problem.used] / CELL).astype(np.int64)
    cells = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
    turned = similarity.scale * patches.normal[problem.used] @ similarity.rotation
    swayed = np.einsum("ni,nij->nj", turned, marks.sway[problem.used])
    try:
        covariance = clustered_covariance(problem.A, problem.weight, problem.off, cells)
        sway = -np.linalg.solve(problem.normal, problem.A.T @ (problem.weight[:, None] * swayed))
    except np.linalg.LinAlgError:
        return None
    residuals = residuals_of(surface, marks.xyz, similarity, reach / 2)  # as of the stage before
    fitted = Fitted(similarity, residuals, reach, covariance, problem.center)
    return Polished(fitted, sway[:3])
