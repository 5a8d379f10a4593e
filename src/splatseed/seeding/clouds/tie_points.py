"""Tie points: the scene's own points that a cloud is aligned with, and how exact they are.

Point X was observed by cameras k with Jacobians J_k = d pixel / d X [2, 3]. With errors of sigma
pixels its covariance is sigma^2 (sum J_k^T J_k)^-1, to first order (Hartley and Zisserman,
"Multiple View Geometry", 2nd ed., sec. 5.2). If all principal points were off by c pixels, X would
be off by -(sum J_k^T J_k)^-1 (sum J_k^T) c. This *sensitivity* is an error that all points share,
so more points do not reduce it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.errors import PointCloudError
from splatseed.pointcloud import ORIGINAL
from splatseed.projection import in_camera, pixel_jacobians
from splatseed.sampling import strided
from splatseed.scene import Image, Scene
from splatseed.similarity import Similarity
from splatseed.tracks import Tracks

Points = Float64[np.ndarray, "N 3"]

MIN_TIE_POINTS, MAX_TIE_POINTS = 200, 6000
MIN_TRACK_LENGTH = 3  # two rays may intersect by chance
PRIOR_DOF = 4
"""Degrees of freedom of the prior on a point's pixel noise, which is the median point's noise."""
MIN_RELATIVE_DEPTH = 0.1
"""Minimum depth / distance of an observation: near 90 degrees off axis, pinhole pixels diverge."""
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class TiePoints:
    """Scene points to align a cloud with."""

    xyz: Points
    brightness: Float64[np.ndarray, " M"]  # 0 to 255
    covariance: Float64[np.ndarray, "M 3 3"]  # scene units squared; 0 if no point has a track
    sensitivity: Float64[np.ndarray, "M 3 2"]  # scene units per pixel of principal points in x, y

    def transformed(self, similarity: Similarity) -> TiePoints:
        """Return the tie points in another frame."""
        A = similarity.scale * similarity.rotation
        xyz = similarity.points(self.xyz)
        return TiePoints(xyz, self.brightness, A @ self.covariance @ A.T, A @ self.sensitivity)


def select_tie_points(scene: Scene) -> TiePoints:
    """Select up to ``MAX_TIE_POINTS`` of the scene's own points, evenly spaced in file order.

    Points without a track get the median variance of the others.
    """
    points, tracks = scene.points, scene.tracks
    usable = (points.source == ORIGINAL) & points.distinct
    if tracks is not None and not tracks.lengths.any():  # a model without observations
        tracks = None
    if tracks is not None:
        usable[: len(tracks)] &= tracks.lengths >= MIN_TRACK_LENGTH
    rows = np.flatnonzero(usable)
    if len(rows) < MIN_TIE_POINTS:
        raise PointCloudError(
            f"at least {MIN_TIE_POINTS} points of the scene's own, to align a cloud with",
            found=f"{len(rows):,}",
            fix="Make some: splatseed sfm IMAGES --poses-from SCENE; or pass `transform`.",
        )
    rows = strided(rows, MAX_TIE_POINTS)
    xyz = points.xyz[rows].astype(np.float64)
    covariance, sensitivity = np.full((len(rows), 3, 3), np.nan), np.zeros((len(rows), 3, 2))
    if tracks is not None:
        tracked = rows < len(tracks)
        chosen = tracks.select(np.isin(np.arange(len(tracks)), rows))
        xyz[tracked] = chosen.xyz
        covariance[tracked], sensitivity[tracked] = triangulation(chosen, scene.images)
    variance = np.trace(covariance, axis1=1, axis2=2) / 3
    unknown = ~np.isfinite(variance)
    typical = 0.0 if unknown.all() else float(np.median(variance[~unknown]))
    covariance[unknown] = typical * np.eye(3)
    brightness = points.rgb[rows].astype(np.float64).mean(axis=1)
    return TiePoints(xyz, brightness, covariance, sensitivity)


def triangulation(
    tracks: Tracks, images: tuple[Image, ...]
) -> tuple[Float64[np.ndarray, "N 3 3"], Float64[np.ndarray, "N 3 2"]]:
    """Return each point's covariance, and its sensitivity to the principal points.

    The covariance is NaN for points with fewer than two observations.
    """
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
    """Return the point of each observation, and the Jacobian d pixel / d point."""
    if not images:
        return np.zeros(0, np.int64), np.zeros((0, 2, 3))
    ids = np.array([image.image_id for image in images])
    order = np.argsort(ids)
    row = order[np.minimum(np.searchsorted(ids[order], tracks.image_ids), len(ids) - 1)]
    point = np.repeat(np.arange(len(tracks)), tracks.lengths)
    poses = np.stack([image.camera.cam_from_world for image in images])[row]
    focals = np.stack([np.diag(image.camera.K)[:2] for image in images])[row]
    x = in_camera(poses, tracks.xyz[point])
    usable = (ids[row] == tracks.image_ids) & (
        x[:, 2] > MIN_RELATIVE_DEPTH * np.linalg.norm(x, axis=1)
    )
    return point[usable], pixel_jacobians(focals[usable], poses[usable], x[usable])


def pixel_noise(
    errors: Float64[np.ndarray, " N"], lengths: Int64[np.ndarray, " N"]
) -> Float64[np.ndarray, " N"]:
    """Estimate the standard deviation of each point's observations per coordinate, in pixels.

    The mean length of L residuals is sigma sqrt(pi / 2) sqrt((2 L - 3) / (2 L)), as the point took
    three of their 2 L degrees of freedom. Short tracks carry little evidence, so each variance is
    shrunk towards the median's, as by an inverse chi-squared prior. Negative errors are unknown.
    """
    free = np.maximum(2.0 * lengths - 3, 1)
    sigma = np.where(errors >= 0, errors, np.nan) * np.sqrt(2 / np.pi * 2 * lengths / free)
    typical = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 1.0
    sigma = np.where(np.isfinite(sigma), sigma, typical)
    variance = (free * sigma**2 + PRIOR_DOF * typical**2) / (free + PRIOR_DOF)
    return np.asarray(np.sqrt(variance))
