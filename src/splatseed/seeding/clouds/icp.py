"""Marks, the scene's own points, and refining how they lie on a cloud.

*Marks.* Mark X was observed by cameras k with Jacobians J_k = d pixel / d X [2, 3]. With errors of
sigma pixels its covariance is sigma^2 (sum J_k^T J_k)^-1, to first order (Hartley and Zisserman,
"Multiple View Geometry", 2nd ed., sec. 5.2). If all principal points were off by c pixels, it would
lie off by -(sum J_k^T J_k)^-1 (sum J_k^T) c: its *sensitivity*, which all marks share, so that no
number of marks makes it smaller.

*ICP.* Marks slide onto the tangent planes of a cloud, with one free scale. A mark p goes to
q = s R p + t, whose nearest cloud point is y with normal n. Each round minimises the sum of
w (n . (q - y))^2 over a small rotation, a shift and a change of scale about the marks' centre (Chen
and Medioni 1992, with a seventh unknown), with Tukey's weights w, whose reach falls from round to
round, to far below the marks' noise: their errors are long-tailed and to one side, so the mode of
the residuals is more exact than their mean (red kitchen: 7 mm instead of 36).

*Polish.* A mark's *patch* is the plane through the ``NEIGHBORS`` cloud points around the nearest
one: their mean m, normal n, and thickness e, their root mean square distance from it. The residual
r = n . (q - m) has the variance v = n^T (s R) C (s R)^T n + e^2 + f^2, with C the mark's covariance
and a floor f. Each round minimises sum w r^2 with w = T(r / (c k sqrt(v))) T(r / reach) / v:
Tukey's weights T, c = ``TUKEY``, and k the median ratio of residuals to sqrt(v). Patches over edges
are left out. The covariance is the robust one by clusters ("sandwich": Huber 1967, Liang and Zeger
1986), H^-1 (sum over cells of g g^T) H^-1 with g = sum w r a over the marks of a cell and a their
rows: it holds whatever the variances are, and marks beside each other may err alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError
from splatseed.pointcloud import ORIGINAL
from splatseed.scene import Image, Scene, Tracks
from splatseed.similarity import Similarity

Points = Float64[np.ndarray, "N 3"]

LEAST_MARKS = 200
MOST_MARKS = 6000
LEAST_VIEWS = 3  # two rays may meet by chance
PRIOR = 4  # degrees of freedom that the median pixel error of all marks counts for, in that of each
GRAZING = 0.1
"""Least depth of an observation over its distance: a pinhole's pixels grow without bound aside."""
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Marks:
    """Points of the scene, to align a cloud with."""

    xyz: Points
    brightness: Float64[np.ndarray, " M"]  # 0 to 255
    covariance: Float64[np.ndarray, "M 3 3"]  # scene units squared; 0 if no mark has a track
    sensitivity: Float64[np.ndarray, "M 3 2"]  # scene units per pixel of principal points in x, y

    def through(self, similarity: Similarity) -> Marks:
        """The marks in another frame."""
        A = similarity.scale * similarity.rotation
        xyz = similarity.points(self.xyz)
        return Marks(xyz, self.brightness, A @ self.covariance @ A.T, A @ self.sensitivity)


def find_marks(scene: Scene) -> Marks:
    """An even choice of the scene's points; those without a track get the median variance."""
    points, tracks = scene.points, scene.tracks
    own = (points.source == ORIGINAL) & points.distinct
    if tracks is not None and not tracks.lengths.any():  # a model without observations
        tracks = None
    if tracks is not None:
        own[: len(tracks)] &= tracks.lengths >= LEAST_VIEWS
    if np.count_nonzero(own) < LEAST_MARKS:
        raise PointCloudError(
            f"at least {LEAST_MARKS} points of the scene's own, to align a cloud with",
            found=f"{np.count_nonzero(own):,}",
            fix="Make some: splatseed sfm IMAGES --poses-from SCENE; or give --transform FILE.",
        )
    which = np.flatnonzero(own)
    which = which[:: -(-len(which) // MOST_MARKS)]
    xyz = points.xyz[which].astype(np.float64)
    covariance, sensitivity = np.full((len(which), 3, 3), np.nan), np.zeros((len(which), 3, 2))
    if tracks is not None:
        tracked = which < len(tracks)
        chosen = tracks.select(np.isin(np.arange(len(tracks)), which))
        xyz[tracked] = chosen.xyz
        covariance[tracked], sensitivity[tracked] = triangulation(chosen, scene.images)
    variance = np.trace(covariance, axis1=1, axis2=2) / 3
    unknown = ~np.isfinite(variance)
    usual = 0.0 if unknown.all() else float(np.median(variance[~unknown]))
    covariance[unknown] = usual * np.eye(3)
    return Marks(xyz, points.rgb[which].astype(np.float64).mean(axis=1), covariance, sensitivity)


def triangulation(
    tracks: Tracks, images: tuple[Image, ...]
) -> tuple[Float64[np.ndarray, "N 3 3"], Float64[np.ndarray, "N 3 2"]]:
    """Covariance, NaN where under two images observed a point, and sensitivity of such points."""
    point, jacobian = _jacobians(tracks, images)
    information, pull = np.zeros((len(tracks), 3, 3)), np.zeros((len(tracks), 3, 2))
    np.add.at(information, point, jacobian.swapaxes(1, 2) @ jacobian)
    np.add.at(pull, point, jacobian.swapaxes(1, 2))
    size = np.trace(information, axis1=1, axis2=2)[:, None, None]
    known = (np.bincount(point, minlength=len(tracks)) >= 2) & (size[:, 0, 0] > 0)
    information = np.where(known[:, None, None], information + RIDGE * size * np.eye(3), np.eye(3))
    inverse = np.linalg.inv(information)
    sigma = pixel_noise(tracks.errors, tracks.lengths)
    covariance = np.where(known[:, None, None], inverse * sigma[:, None, None] ** 2, np.nan)
    return covariance, np.where(known[:, None, None], -inverse @ pull, 0.0)


def _jacobians(
    tracks: Tracks, images: tuple[Image, ...]
) -> tuple[Int64[np.ndarray, " T"], Float64[np.ndarray, "T 2 3"]]:
    """Of the observations: the point of each, and how its pixel follows the point.

    u = f x / z + c gives du/dX = (f / z) (r_x - (x / z) r_z), r_x and r_z rows of the rotation.
    """
    if not images:
        return np.zeros(0, np.int64), np.zeros((0, 2, 3))
    ids = np.array([image.image_id for image in images])
    order = np.argsort(ids)
    row = order[np.minimum(np.searchsorted(ids[order], tracks.image_ids), len(ids) - 1)]
    point = np.repeat(np.arange(len(tracks)), tracks.lengths)
    poses = np.stack([image.camera.cam_from_world for image in images])[row]
    focals = np.stack([np.diag(image.camera.K)[:2] for image in images])[row]
    x = np.einsum("nij,nj->ni", poses[:, :3, :3], tracks.xyz[point]) + poses[:, :3, 3]
    seen = (ids[row] == tracks.image_ids) & (x[:, 2] > GRAZING * np.linalg.norm(x, axis=1))
    poses, focals, x = poses[seen], focals[seen], x[seen]
    aside = (x[:, :2] / x[:, 2:])[:, :, None] * poses[:, None, 2, :3]
    return point[seen], (focals / x[:, 2:])[:, :, None] * (poses[:, :2, :3] - aside)


def pixel_noise(
    errors: Float64[np.ndarray, " N"], lengths: Int64[np.ndarray, " N"]
) -> Float64[np.ndarray, " N"]:
    """Standard deviation of a point's observations in each coordinate, pixels.

    The mean length of L residuals is sigma sqrt(pi / 2) sqrt((2 L - 3) / (2 L)), as the point took
    three of their 2 L degrees of freedom. Short tracks say little, so each variance is drawn
    towards the median's, as by an inverse chi-squared prior. Errors are negative where unknown.
    """
    free = np.maximum(2.0 * lengths - 3, 1)
    sigma = np.where(errors >= 0, errors, np.nan) * np.sqrt(2 / np.pi * 2 * lengths / free)
    usual = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 1.0
    sigma = np.where(np.isfinite(sigma), sigma, usual)
    return np.asarray(np.sqrt((free * sigma**2 + PRIOR * usual**2) / (free + PRIOR)))


STILL = 1e-7
LEAST = 12  # marks within reach that a fit needs
TANGENT_NEIGHBORS = 12
BLOCK = 1 << 15


@dataclass(frozen=True, eq=False)
class Surface:
    """A cloud to align with: points, unit normals of either sign, and a tree."""

    xyz: Points
    normals: Points
    tree: cKDTree

    @classmethod
    def of(cls, xyz: Points) -> Surface:
        """Normals are the last principal axes of a point and its 11 neighbours."""
        tree, normals = cKDTree(xyz, balanced_tree=False), np.empty_like(xyz)
        for start in range(0, len(xyz), BLOCK):
            part = slice(start, start + BLOCK)
            idx = tree.query(xyz[part], min(TANGENT_NEIGHBORS, len(xyz)))[1]
            near = xyz[idx] - xyz[idx].mean(axis=1, keepdims=True)
            normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
        return cls(xyz, normals, tree)

    def pairs(self, q: Points, bound: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normals, signed plane residuals and distances of marks in the cloud's frame.

        Beyond ``bound`` the distance is infinite, and the others say nothing.
        """
        distance, idx = self.tree.query(q, distance_upper_bound=bound)
        idx = np.minimum(idx, len(self.xyz) - 1)
        normals = self.normals[idx]
        return normals, np.einsum("ij,ij->i", normals, q - self.xyz[idx]), distance


@dataclass(frozen=True, eq=False)
class Fitted:
    """An alignment, and how far it leaves marks from the cloud, in the scene's units.

    That is from the nearest point's tangent plane, or from the point itself beyond the reach.
    """

    cloud_from_scene: Similarity
    residuals: Float64[np.ndarray, " M"]

    def share(self, close: float) -> float:
        """The share of marks that are so close to the cloud."""
        return float(np.mean(self.residuals < close))


@dataclass(frozen=True, eq=False)
class Polished(Fitted):
    """An alignment after the last stage."""

    covariance: Float64[np.ndarray, "7 7"]  # rotation about the centre, shift, log scale; cloud's
    center: Float64[np.ndarray, " 3"]  # of the marks, in the cloud's frame
    sensitivity: Float64[np.ndarray, "3 2"]  # radians per pixel of principal points in x, y

    @property
    def turn(self) -> float:
        """Standard error of the rotation, radians."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))


def fit(
    surface: Surface,
    marks: Points,
    start: Similarity,
    far: float,
    rounds: int,
    least: float,
    shrink: float,
) -> Fitted:
    """Refine an alignment by ICP, with a reach that falls from ``far`` to ``least``.

    Raises:
        LinAlgError: Too few marks are within reach, or nothing holds them.
    """
    similarity, reach = start, far
    for _ in range(rounds):
        similarity, shift = _step(surface, marks, similarity, reach)
        if shift < STILL and reach <= least:
            break
        reach = max(reach * shrink, least)
    residuals, inside = _residuals(surface, marks, similarity, reach)
    _check_enough(inside)
    return Fitted(similarity, residuals)


def _check_enough(used: np.ndarray) -> None:
    if np.count_nonzero(used) < LEAST:
        raise np.linalg.LinAlgError


def _step(
    surface: Surface, marks: Points, start: Similarity, reach: float
) -> tuple[Similarity, float]:
    """One round: the better similarity, and how far it moved."""
    q, limit = start.points(marks), reach * start.scale
    normals, off, distance = surface.pairs(q, 2 * limit)
    near = np.isfinite(distance)
    _check_enough(near)
    q, normals, off = q[near], normals[near], off[near]
    weights = _tukey(off / limit)
    _check_enough(weights)
    center = np.average(q, axis=0, weights=weights)
    A = _design(q - center, normals)
    normal = (A * weights[:, None]).T @ A
    x = np.linalg.solve(normal, -(A * weights[:, None]).T @ off)
    return moved(start, center, x), float(np.abs(x).max())


def _design(around: np.ndarray, normals: np.ndarray) -> Float64[np.ndarray, "M 7"]:
    """Rows of n . (w x a + t + d a) for the rotation w, the shift t and the change of scale d."""
    along = np.einsum("ij,ij->i", normals, around)
    return np.column_stack([np.cross(around, normals), normals, along])


def _tukey(u: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    return np.asarray((1 - np.minimum(np.abs(u), 1.0) ** 2) ** 2)


def moved(start: Similarity, center: np.ndarray, x: np.ndarray) -> Similarity:
    """A similarity followed by a small one, (w, t, d), about a centre."""
    turn, angle = np.eye(3), float(np.linalg.norm(x[:3]))
    if angle >= 1e-12:  # Rodrigues' formula
        a, b, c = x[:3] / angle
        K = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        turn = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    grow = float(np.exp(np.clip(x[6], -0.2, 0.2)))
    shifted = grow * turn @ (start.translation - center) + center + x[3:6]
    return Similarity(grow * start.scale, turn @ start.rotation, shifted)


def _residuals(
    surface: Surface, marks: Points, similarity: Similarity, reach: float
) -> tuple[Float64[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """Distances of marks from the cloud, as ``Fitted`` has them, and which are within reach."""
    limit = reach * similarity.scale
    _, off, distance = surface.pairs(similarity.points(marks))
    inside = (np.abs(off) < limit) & (distance < 2 * limit)
    return np.where(inside, np.abs(off), distance) / similarity.scale, inside


NEIGHBORS = 20
FLAT = 0.1
"""Greatest thickness of a patch, over its narrower extent; half of the patches always pass, so that
noisy clouds keep theirs."""
FLOOR = 0.0005  # f, in the scene's units
TUKEY = 4.685  # loses 5% of the precision of least squares where errors are normal
NORMAL_MEDIAN = 0.6745  # median absolute deviation of a normal distribution, in standard deviations
EXACT = 1e-3  # least k: marks without any error would not count at all
ROUNDS, STEPS = 4, 12
CELL = 0.1  # side of the cells in which errors may be alike, in the scene's units


class _Patches(NamedTuple):
    """Planes for some marks."""

    mean: Points
    normal: Points
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

    def solve(self, off: np.ndarray) -> np.ndarray:
        """The unknowns that take away offsets [m] or [m, k] along the normals."""
        normal = (self.A * self.weight[:, None]).T @ self.A
        return np.asarray(np.linalg.solve(normal, -self.A.T @ (self.weight * off.T).T))


def polish(surface: Surface, marks: Marks, start: Similarity, reach: float) -> Polished | None:
    """Make an alignment that is nearly right as exact as the marks allow.

    The marks' root mean square distance is the unit; residuals beyond ``reach`` do not count. None
    where too few marks lie on flat parts of the cloud, or nothing holds them.
    """
    similarity = start
    try:
        for _ in range(ROUNDS):
            patches = _patches(surface, similarity.points(marks.xyz))
            for _ in range(STEPS):
                problem = _problem(patches, marks, similarity, reach)
                similarity = moved(similarity, problem.center, problem.solve(problem.off))
        center, A, weight, off, used = problem = _problem(patches, marks, similarity, reach)
        turned = similarity.scale * patches.normal[used] @ similarity.rotation
        sensitivity = problem.solve(np.einsum("ni,nij->nj", turned, marks.sensitivity[used]))
        places = np.floor(marks.xyz[used] / CELL).astype(np.int64)
        cells = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
        covariance = clustered_covariance(A, weight, off, cells)
    except np.linalg.LinAlgError:
        return None
    residuals, _ = _residuals(surface, marks.xyz, similarity, reach / 2)  # as of the stage before
    return Polished(similarity, residuals, covariance, center, sensitivity[:3])


def _patches(surface: Surface, q: Points) -> _Patches:
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


def _problem(patches: _Patches, marks: Marks, similarity: Similarity, reach: float) -> _Problem:
    q, limit = similarity.points(marks.xyz), reach * similarity.scale
    away = q - patches.mean
    off = np.einsum("ij,ij->i", patches.normal, away)
    beside = np.linalg.norm(away - off[:, None] * patches.normal, axis=1)
    near = patches.flat & (beside < patches.radius) & (np.abs(off) < limit)
    _check_enough(near)
    turned = similarity.scale * patches.normal @ similarity.rotation
    variance = np.einsum("ni,nij,nj->n", turned, marks.covariance, turned)
    variance += patches.thickness**2 + (FLOOR * similarity.scale) ** 2
    ratio = off / np.sqrt(variance)
    typical = max(float(np.median(np.abs(ratio[near]))) / NORMAL_MEDIAN, EXACT)
    weight = np.where(near, _tukey(ratio / (TUKEY * typical)) * _tukey(off / limit) / variance, 0.0)
    used = weight > 0
    _check_enough(used)
    center = np.average(q[used], axis=0, weights=weight[used])
    A = _design(q[used] - center, patches.normal[used])
    return _Problem(center, A, weight[used], off[used], used)


def clustered_covariance(
    A: Float64[np.ndarray, "m k"],
    weight: Float64[np.ndarray, " m"],
    off: Float64[np.ndarray, " m"],
    cells: Int64[np.ndarray, " m"],
) -> Float64[np.ndarray, "k k"]:
    """Covariance [k, k] of weighted least squares whose errors are alike within cells only."""
    scores = np.zeros((int(cells.max()) + 1, A.shape[1]))
    np.add.at(scores, cells, A * (weight * off)[:, None])
    bread = np.linalg.inv((A * weight[:, None]).T @ A)
    return np.asarray(bread @ (scores.T @ scores) @ bread)
