"""ICP: refine a similarity that lays a scene's tie points on a cloud.

*Fit.* Point-to-plane ICP (Chen and Medioni 1992) with a free scale. A tie point p goes to
q = s R p + t, whose nearest cloud point is y with normal n. Each iteration minimises the sum of
w (n . (q - y))^2 over a small rotation, a shift and a change of scale about the centre of the tie
points, with Tukey weights w. Their reach shrinks to far below the noise of the tie points: its
distribution is long-tailed and one-sided, so the mode of the residuals is more exact than their
mean (red kitchen: 7 mm instead of 36).

*Refinement.* A tie point's *patch* is the plane through the ``neighbors`` cloud points around the
nearest one: their mean m, normal n, and thickness e, their root mean square distance from it. The
residual r = n . (q - m) has the variance v = n^T (s R) C (s R)^T n + e^2 + f^2, with C the tie
point's covariance and a noise floor f. Each iteration minimises sum w r^2 with
w = T(r / (c k sqrt(v))) T(r / reach) / v: Tukey's weights T, c = ``TUKEY``, and k the median ratio
of residuals to sqrt(v). Patches over edges are left out. The covariance of the result is robust and
clustered ("sandwich": Huber 1967, Liang and Zeger 1986): H^-1 (sum over cells of g g^T) H^-1 with
g = sum w r a over the tie points of a cell and a their rows. It holds for any true variances, and
for errors that are correlated between neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from splatseed.seeding.clouds.tie_points import Points, TiePoints
from splatseed.similarity import Similarity

CONVERGED = 1e-7  # change of the parameters, radians and cloud units, below which iterations end
MIN_INLIERS = 12  # tie points within reach that a fit needs
NORMAL_NEIGHBORS = 12  # cloud points, the point itself included, that determine its normal
BLOCK = 1 << 15


@dataclass(frozen=True, eq=False)
class CloudSurface:
    """A cloud to align with: points, unit normals of either sign, and a tree."""

    xyz: Points
    normals: Points
    tree: cKDTree

    @classmethod
    def of(cls, xyz: Points) -> CloudSurface:
        """Estimate normals as the last principal axis of a point and its 11 nearest."""
        tree, normals = cKDTree(xyz, balanced_tree=False), np.empty_like(xyz)
        for start in range(0, len(xyz), BLOCK):
            part = slice(start, start + BLOCK)
            idx = tree.query(xyz[part], min(NORMAL_NEIGHBORS, len(xyz)))[1]
            near = xyz[idx] - xyz[idx].mean(axis=1, keepdims=True)
            normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
        return cls(xyz, normals, tree)

    def pairs(self, q: Points, bound: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return normal, signed distance to the plane, and distance of each q's nearest point.

        Beyond ``bound`` the distance is infinite and the other two are meaningless.
        """
        distance, idx = self.tree.query(q, distance_upper_bound=bound)
        idx = np.minimum(idx, len(self.xyz) - 1)
        normals = self.normals[idx]
        return normals, np.einsum("ij,ij->i", normals, q - self.xyz[idx]), distance


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity, and the residuals of the tie points in scene units.

    A residual is the distance from the nearest point's tangent plane, or, beyond the reach, from
    the point itself.
    """

    cloud_from_scene: Similarity
    residuals: Float64[np.ndarray, " M"]

    def inlier_ratio(self, distance: float) -> float:
        """Return the fraction of tie points within a distance of the cloud."""
        return float(np.mean(self.residuals < distance))


@dataclass(frozen=True, eq=False)
class RefinedFit(SimilarityFit):
    """The result of ``refine``, with its uncertainty."""

    covariance: Float64[np.ndarray, "7 7"]  # rotation about the center, shift, log scale; cloud's
    center: Float64[np.ndarray, " 3"]  # of the tie points, in the cloud's frame
    sensitivity: Float64[np.ndarray, "3 2"]  # radians per pixel of principal points in x, y

    @property
    def rotation_error(self) -> float:
        """Standard error of the rotation, radians."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))


class Stage(NamedTuple):
    """One pass of ICP over several candidates; lengths are in extents of the scene."""

    candidates: int
    tie_points: int
    iterations: int
    first_reach: float  # residual at which a weight becomes zero, in the first iteration
    last_reach: float
    decay: float  # factor of the reach from one iteration to the next
    inlier_distance: float  # by which the candidates are ranked


def fit(surface: CloudSurface, tie_xyz: Points, start: Similarity, stage: Stage) -> SimilarityFit:
    """Fit an alignment by ICP, with a reach that shrinks as the stage prescribes.

    Raises:
        LinAlgError: Too few tie points are within reach, or they leave a direction free.
    """
    similarity, reach = start, stage.first_reach
    for _ in range(stage.iterations):
        similarity, change = _step(surface, tie_xyz, similarity, reach)
        if change < CONVERGED and reach <= stage.last_reach:
            break
        reach = max(reach * stage.decay, stage.last_reach)
    residuals, inliers = _residuals(surface, tie_xyz, similarity, reach)
    _require_inliers(inliers)
    return SimilarityFit(similarity, residuals)


def _require_inliers(used: np.ndarray) -> None:
    if np.count_nonzero(used) < MIN_INLIERS:
        raise np.linalg.LinAlgError


def _step(
    surface: CloudSurface, tie_xyz: Points, start: Similarity, reach: float
) -> tuple[Similarity, float]:
    """Do one iteration; return the new similarity and the largest change of a parameter."""
    q, limit = start.points(tie_xyz), reach * start.scale
    normals, off, distance = surface.pairs(q, 2 * limit)
    near = np.isfinite(distance)
    _require_inliers(near)
    q, normals, off = q[near], normals[near], off[near]
    weights = _tukey(off / limit)
    _require_inliers(weights)
    center = np.average(q, axis=0, weights=weights)
    A = _design(q - center, normals)
    normal = (A * weights[:, None]).T @ A
    x = np.linalg.solve(normal, -(A * weights[:, None]).T @ off)
    return retract(start, center, x), float(np.abs(x).max())


def _design(offsets: np.ndarray, normals: np.ndarray) -> Float64[np.ndarray, "M 7"]:
    """Return rows of n . (w x a + t + d a), linear in the rotation w, shift t and log scale d."""
    along = np.einsum("ij,ij->i", normals, offsets)
    return np.column_stack([np.cross(offsets, normals), normals, along])


def _tukey(u: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    return np.asarray((1 - np.minimum(np.abs(u), 1.0) ** 2) ** 2)


def retract(start: Similarity, center: np.ndarray, x: np.ndarray) -> Similarity:
    """Apply a small similarity (rotation vector, shift, log scale) [7] about a centre."""
    rotation, angle = np.eye(3), float(np.linalg.norm(x[:3]))
    if angle >= 1e-12:  # Rodrigues' formula
        a, b, c = x[:3] / angle
        K = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        rotation = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    scale = float(np.exp(np.clip(x[6], -0.2, 0.2)))
    translation = scale * rotation @ (start.translation - center) + center + x[3:6]
    return Similarity(scale * start.scale, rotation @ start.rotation, translation)


def _residuals(
    surface: CloudSurface, tie_xyz: Points, similarity: Similarity, reach: float
) -> tuple[Float64[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """Return residuals as ``SimilarityFit`` has them, and which tie points are within reach."""
    limit = reach * similarity.scale
    _, off, distance = surface.pairs(similarity.points(tie_xyz))
    inside = (np.abs(off) < limit) & (distance < 2 * limit)
    return np.where(inside, np.abs(off), distance) / similarity.scale, inside


TUKEY = 4.685  # loses 5% of the precision of least squares where errors are normal
NORMAL_MEDIAN = 0.6745  # median absolute deviation of a normal distribution, in standard deviations


@dataclass(frozen=True)
class RefineSettings:
    """Settings of ``refine``; lengths are in extents of the scene."""

    neighbors: int = 20
    """Cloud points of a patch."""
    max_flatness: float = 0.1
    """Maximum thickness of a patch, relative to its narrower extent; the flatter half of all
    patches always passes, so that noisy clouds keep some."""
    noise_floor: float = 0.0005
    """f."""
    min_ratio: float = 1e-3
    """Minimum k: exact tie points would otherwise all have weight zero."""
    rounds: int = 4
    """How often the patches are found anew."""
    iterations: int = 12
    """Iterations of weighted least squares per round."""
    cell: float = 0.1
    """Side of the cells in which errors may be correlated."""


REFINEMENT = RefineSettings()


class _Patches(NamedTuple):
    """A plane for each tie point."""

    mean: Points
    normal: Points
    thickness: Float64[np.ndarray, " M"]
    radius: Float64[np.ndarray, " M"]
    flat: Bool[np.ndarray, " M"]


class _Problem(NamedTuple):
    """Weighted least squares, linearised at an alignment."""

    center: Float64[np.ndarray, " 3"]
    A: Float64[np.ndarray, "m 7"]
    weight: Float64[np.ndarray, " m"]
    off: Float64[np.ndarray, " m"]
    used: Bool[np.ndarray, " M"]  # tie points of positive weight

    def solve(self, off: np.ndarray) -> np.ndarray:
        """Return the parameters that cancel offsets [m] or [m, k] along the normals."""
        normal = (self.A * self.weight[:, None]).T @ self.A
        return np.asarray(np.linalg.solve(normal, -self.A.T @ (self.weight * off.T).T))


def refine(
    surface: CloudSurface,
    tie_points: TiePoints,
    start: Similarity,
    reach: float,
    settings: RefineSettings = REFINEMENT,
) -> RefinedFit | None:
    """Refine a nearly correct alignment to the precision of the tie points.

    Tie points are at unit extent; residuals beyond ``reach`` get no weight. Returns None if too few
    tie points lie on flat parts of the cloud, or leave a direction free.
    """
    similarity = start
    try:
        for _ in range(settings.rounds):
            patches = _patches(surface, similarity.points(tie_points.xyz), settings)
            for _ in range(settings.iterations):
                problem = _problem(patches, tie_points, similarity, reach, settings)
                similarity = retract(similarity, problem.center, problem.solve(problem.off))
        problem = _problem(patches, tie_points, similarity, reach, settings)
        center, A, weight, off, used = problem
        rotated = similarity.scale * patches.normal[used] @ similarity.rotation
        shift = np.einsum("ni,nij->nj", rotated, tie_points.sensitivity[used])
        sensitivity = problem.solve(shift)
        cell_of = np.floor(tie_points.xyz[used] / settings.cell).astype(np.int64)
        cells = np.unique(cell_of, axis=0, return_inverse=True)[1].reshape(-1)
        covariance = clustered_covariance(A, weight, off, cells)
    except np.linalg.LinAlgError:
        return None
    # At the reach of the last stage of ``fit``, so that inlier ratios compare.
    residuals, _ = _residuals(surface, tie_points.xyz, similarity, reach / 2)
    return RefinedFit(similarity, residuals, covariance, center, sensitivity[:3])


def _patches(surface: CloudSurface, q: Points, settings: RefineSettings) -> _Patches:
    nearest = surface.tree.query(q)[1]
    num = min(settings.neighbors, len(surface.xyz))
    points = surface.xyz[surface.tree.query(surface.xyz[nearest], num)[1]]
    mean = points.mean(axis=1)
    centred = points - mean[:, None]
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred) / points.shape[1])
    thickness, width = np.sqrt(np.maximum(spread[:, :2].T, 0.0))
    flatness = thickness / np.maximum(width, np.finfo(float).tiny)
    radius = np.linalg.norm(centred, axis=2).max(axis=1)
    flat = flatness <= max(settings.max_flatness, float(np.median(flatness)))
    return _Patches(mean, axes[:, :, 0], thickness, radius, flat)


def _problem(
    patches: _Patches,
    tie_points: TiePoints,
    similarity: Similarity,
    reach: float,
    settings: RefineSettings,
) -> _Problem:
    q, limit = similarity.points(tie_points.xyz), reach * similarity.scale
    away = q - patches.mean
    off = np.einsum("ij,ij->i", patches.normal, away)
    lateral = np.linalg.norm(away - off[:, None] * patches.normal, axis=1)
    near = patches.flat & (lateral < patches.radius) & (np.abs(off) < limit)
    _require_inliers(near)
    rotated = similarity.scale * patches.normal @ similarity.rotation
    variance = np.einsum("ni,nij,nj->n", rotated, tie_points.covariance, rotated)
    variance += patches.thickness**2 + (settings.noise_floor * similarity.scale) ** 2
    ratio = off / np.sqrt(variance)
    typical = max(float(np.median(np.abs(ratio[near]))) / NORMAL_MEDIAN, settings.min_ratio)
    weight = np.where(near, _tukey(ratio / (TUKEY * typical)) * _tukey(off / limit) / variance, 0.0)
    used = weight > 0
    _require_inliers(used)
    center = np.average(q[used], axis=0, weights=weight[used])
    A = _design(q[used] - center, patches.normal[used])
    return _Problem(center, A, weight[used], off[used], used)


def clustered_covariance(
    A: Float64[np.ndarray, "m k"],
    weight: Float64[np.ndarray, " m"],
    off: Float64[np.ndarray, " m"],
    cells: Int64[np.ndarray, " m"],
) -> Float64[np.ndarray, "k k"]:
    """Return the covariance [k, k] of weighted least squares with errors correlated within cells.

    ``off`` are the residuals, ``cells`` the index of each row's cell.
    """
    scores = np.zeros((int(cells.max()) + 1, A.shape[1]))
    np.add.at(scores, cells, A * (weight * off)[:, None])
    bread = np.linalg.inv((A * weight[:, None]).T @ A)
    return np.asarray(bread @ (scores.T @ scores) @ bread)
