"""Refining an alignment: robust similarity ICP, and a last stage in which exact marks count more.

*ICP.* Marks slide onto the tangent planes of a cloud, with one free scale. A mark p goes to
q = s R p + t, whose nearest cloud point is y with normal n. Each round minimises the sum of
w (n . (q - y))^2 over a small rotation, a shift and a change of scale about the marks' centre (Chen
and Medioni 1992, with a seventh unknown), with Tukey's weights w, whose reach falls from round to
round. Residuals are in the cloud's units, and divided by s where alignments are compared. The last
reach is far below the marks' noise: their errors are long-tailed and to one side, so the mode of
the residuals is more exact than their mean (red kitchen: 7 mm instead of 36). The covariance of the
seven unknowns is that of least squares at the last round, with marks taken for equally exact.

*Polish.* A mark has the covariance C in its own frame. Its *patch* is the plane through the
``NEIGHBORS`` cloud points around the nearest one: their mean m, normal n, and thickness e, their
root mean square distance from it. The residual r = n . (q - m) has the variance
v = n^T (s R) C (s R)^T n + e^2 + f^2, with a floor f for what no model holds. Each round minimises
sum w r^2 with w = T(r / (c k sqrt(v))) T(r / reach) / v: Tukey's weights T, c = ``TUKEY``, and k
the median ratio of residuals to sqrt(v), so that only the ratios of the variances matter. Patches
over edges, whose mean lies off the surface, are left out. The covariance is the robust one
("sandwich": Huber 1967; by clusters, Liang and Zeger 1986), H^-1 (sum over cells of g g^T) H^-1
with g = sum w r a over the marks of a cell and a their rows: it holds whatever the variances are,
and marks beside each other may err alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from splatseed.seeding.alignment.marks import Marks
from splatseed.similarity import Similarity

STILL = 1e-7
LEAST = 12
"""Marks within reach that a fit needs."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A cloud to align with.

    Args:
        xyz: Points, float64 [N, 3].
        normals: Unit, of either sign, float64 [N, 3].
        tree: Of the points.
    """

    xyz: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]
    tree: cKDTree


@dataclass(frozen=True, eq=False)
class Fitted:
    """An alignment.

    Args:
        cloud_from_scene: Where marks go.
        residuals: Distance of each mark from its nearest cloud point's tangent plane, or from the
            point itself where that is beyond the reach, in the scene's units, float64 [M].
        reach: Residuals within which marks counted at last, in the scene's units.
        covariance: Of rotation (radians, about ``center``), shift and log scale, float64 [7, 7], in
            the cloud's units.
        center: The centre of the marks, in the cloud's frame.
    """

    cloud_from_scene: Similarity
    residuals: Float64[np.ndarray, " M"]
    reach: float
    covariance: Float64[np.ndarray, "7 7"]
    center: Float64[np.ndarray, " 3"]

    @property
    def turn(self) -> float:
        """Standard error of the rotation, radians."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))


def fit(
    surface: Surface,
    marks: Float64[np.ndarray, "M 3"],
    start: Similarity,
    far: float,
    rounds: int,
    least: float,
    shrink: float,
) -> Fitted | None:
    """Refine an alignment; None where too few marks are within reach, or nothing holds them.

    From ``start``, in ``rounds`` whose reach falls from ``far`` to ``least`` by the factor
    ``shrink``, in the scene's units.
    """
    similarity, reach = start, far
    for _ in range(rounds):
        step = _step(surface, marks, similarity, reach)
        if step is None:
            return None
        similarity, shift = step
        if shift < STILL and reach <= least:
            break
        reach = max(reach * shrink, least)
    return _result(surface, marks, similarity, reach)


def _pairs(
    surface: Surface, q: Float64[np.ndarray, "M 3"], bound: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, signed plane residuals and distances of marks in the cloud's frame.

    Beyond ``bound`` the distance is infinite, and the others say nothing.
    """
    distance, idx = surface.tree.query(q, distance_upper_bound=bound)
    idx = np.minimum(idx, len(surface.xyz) - 1)
    normals = surface.normals[idx]
    return normals, np.einsum("ij,ij->i", normals, q - surface.xyz[idx]), distance


def _step(
    surface: Surface, marks: Float64[np.ndarray, "M 3"], start: Similarity, reach: float
) -> tuple[Similarity, float] | None:
    """One round: the better similarity, and how far it moved."""
    q, limit = start.points(marks), reach * start.scale
    normals, off, distance = _pairs(surface, q, 2 * limit)
    near = np.isfinite(distance)
    if np.count_nonzero(near) < LEAST:
        return None
    q, normals, off = q[near], normals[near], off[near]
    weights = (1 - np.minimum(np.abs(off) / limit, 1.0) ** 2) ** 2
    if np.count_nonzero(weights) < LEAST:
        return None
    center = np.average(q, axis=0, weights=weights)
    A = design(q - center, normals)
    normal = (A * weights[:, None]).T @ A
    try:
        x = np.linalg.solve(normal, -(A * weights[:, None]).T @ off)
    except np.linalg.LinAlgError:
        return None
    return moved(start, center, x), float(np.abs(x).max())


def design(around: np.ndarray, normals: np.ndarray) -> Float64[np.ndarray, "M 7"]:
    """Rows of n . (w x a + t + d a) for the rotation w, the shift t and the change of scale d."""
    along = np.einsum("ij,ij->i", normals, around)
    return np.column_stack([np.cross(around, normals), normals, along])


def moved(start: Similarity, center: np.ndarray, x: np.ndarray) -> Similarity:
    """A similarity followed by a small one about a centre."""
    turn, grow = _rotation(x[:3]), float(np.exp(np.clip(x[6], -0.2, 0.2)))
    rotation, scale = turn @ start.rotation, grow * start.scale
    moved = grow * turn @ (start.translation - center) + center + x[3:6]
    return Similarity(scale, rotation, moved)


def _rotation(w: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(w))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = w / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def residuals_of(
    surface: Surface, marks: Float64[np.ndarray, "M 3"], similarity: Similarity, reach: float
) -> Float64[np.ndarray, " M"]:
    """Distances of marks from the cloud, as ``Fitted`` has them, in the scene's units."""
    limit = reach * similarity.scale
    _, off, distance = _pairs(surface, similarity.points(marks))
    inside = (np.abs(off) < limit) & (distance < 2 * limit)
    return np.where(inside, np.abs(off), distance) / similarity.scale


def _result(
    surface: Surface, marks: Float64[np.ndarray, "M 3"], similarity: Similarity, reach: float
) -> Fitted | None:
    q, limit = similarity.points(marks), reach * similarity.scale
    normals, off, distance = _pairs(surface, q)
    inside = (np.abs(off) < limit) & (distance < 2 * limit)
    if np.count_nonzero(inside) < LEAST:
        return None
    center = q[inside].mean(axis=0)
    A = design(q[inside] - center, normals[inside])
    try:
        covariance = np.linalg.inv(A.T @ A) * float(np.mean(off[inside] ** 2))
    except np.linalg.LinAlgError:
        return None
    residuals = residuals_of(surface, marks, similarity, reach)
    return Fitted(similarity, residuals, reach, covariance, center)


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
        sensitivity: Rotation by which it would be off were all principal points off by a pixel in
            x, or in y, radians, float64 [3, 2].
    """

    fitted: Fitted
    sensitivity: Float64[np.ndarray, "3 2"]


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

    The marks' root mean square distance is the unit; residuals beyond ``reach`` do not count. None
    where too few marks lie on flat parts of the cloud.
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
    return _polished(surface, marks, similarity, patches, reach)


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

    Raises ``LinAlgError`` if the rows do not hold the unknowns.
    """
    scores = np.zeros((int(cells.max()) + 1, A.shape[1]))
    np.add.at(scores, cells, A * (weight * off)[:, None])
    bread = np.linalg.inv((A * weight[:, None]).T @ A)
    return np.asarray(bread @ (scores.T @ scores) @ bread)


def _polished(
    surface: Surface, marks: Marks, similarity: Similarity, patches: _Patches, reach: float
) -> Polished | None:
    problem = _problem(patches, marks, similarity, reach)
    if problem is None:
        return None
    places = np.floor(marks.xyz[problem.used] / CELL).astype(np.int64)
    cells = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
    turned = similarity.scale * patches.normal[problem.used] @ similarity.rotation
    moved_by_centers = np.einsum("ni,nij->nj", turned, marks.sensitivity[problem.used])
    try:
        covariance = clustered_covariance(problem.A, problem.weight, problem.off, cells)
        sensitivity = -np.linalg.solve(
            problem.normal, problem.A.T @ (problem.weight[:, None] * moved_by_centers)
        )
    except np.linalg.LinAlgError:
        return None
    residuals = residuals_of(surface, marks.xyz, similarity, reach / 2)  # as of the stage before
    fitted = Fitted(similarity, residuals, reach, covariance, problem.center)
    return Polished(fitted, sensitivity[:3])
