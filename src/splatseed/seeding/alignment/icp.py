"""Robust similarity ICP: marks slide onto the tangent planes of a cloud, with one free scale.

Notation: a mark p goes to q = s R p + t, whose nearest cloud point is y with normal n. Each round
minimises the sum of w (n . (q - y))^2 over a small rotation, a shift and a change of scale about
the marks' centre (Chen and Medioni 1992, with a seventh unknown), with Tukey's weights w, whose
reach falls from round to round. Residuals are in the cloud's units, and divided by s where
alignments are compared. The last reach is far below the marks' noise: their errors are long-tailed
and to one side, so the mode of the residuals is more exact than their mean (red kitchen: 7 mm
instead of 36).
Promise: the covariance of the seven unknowns is that of least squares at the last round. It takes
marks for equally exact; ``polish.py`` does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from splatseed.similarity import Similarity

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

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
    """Refine an alignment.

    Args:
        surface: The cloud.
        marks: The scene's points.
        start: ``cloud_from_scene`` to begin with.
        far: The first reach, in the scene's units.
        rounds: How many rounds.
        least: The least reach, in the scene's units.
        shrink: Factor of the reach from round to round.

    Returns:
        The alignment; None where too few marks are within reach, or nothing holds them.
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
