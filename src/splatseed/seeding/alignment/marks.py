"""Marks: the scene's own points, and how exactly each was triangulated.

Notation: mark X was observed by cameras k with Jacobians J_k = d pixel / d X [2, 3]. With errors of
sigma pixels in each coordinate its covariance is sigma^2 (sum J_k^T J_k)^-1, to first order
(Hartley and Zisserman, "Multiple View Geometry", 2nd ed., sec. 5.2): long along the rays where
cameras stand close together. If all principal points were off by c pixels, it would lie off by
-(sum J_k^T J_k)^-1 (sum J_k^T) c: its *sensitivity*, which all marks share, so that no number of
marks makes it smaller.
Promise: marks without tracks get the median variance of the others, in all directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.errors import PointCloudError
from splatseed.pointcloud import ORIGINAL
from splatseed.scene import Image, Scene, Tracks
from splatseed.similarity import Similarity

LEAST_MARKS = 200
MOST_MARKS = 6000
LEAST_VIEWS = 3
"""Two rays may meet by chance."""
PRIOR = 4
"""Degrees of freedom that the median pixel error of all marks counts for, in that of each."""
GRAZING = 0.1
"""Least depth of an observation over its distance: a pinhole's pixels grow without bound aside."""
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Marks:
    """Points of the scene, to align a cloud with.

    Args:
        xyz: float64 [M, 3].
        brightness: 0 to 255, float64 [M].
        covariance: Of the positions, scene units squared, float64 [M, 3, 3]; 0 where none of the
            marks has a track.
        sensitivity: How far each moves per pixel of the principal points in x and y, scene units,
            float64 [M, 3, 2].
    """

    xyz: Float64[np.ndarray, "M 3"]
    brightness: Float64[np.ndarray, " M"]
    covariance: Float64[np.ndarray, "M 3 3"]
    sensitivity: Float64[np.ndarray, "M 3 2"]

    def through(self, similarity: Similarity) -> Marks:
        """The marks in another frame."""
        A = similarity.scale * similarity.rotation
        xyz = similarity.points(self.xyz)
        return Marks(xyz, self.brightness, A @ self.covariance @ A.T, A @ self.sensitivity)


def find_marks(scene: Scene) -> Marks:
    """An even choice of the scene's own points.

    Raises:
        PointCloudError: There are too few.
    """
    points, tracks = scene.points, scene.tracks
    own = (points.source == ORIGINAL) & points.distinct
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
    brightness = points.rgb[which].astype(np.float64).mean(axis=1)
    return Marks(xyz, brightness, _filled(covariance), sensitivity)


def triangulation(
    tracks: Tracks, images: tuple[Image, ...]
) -> tuple[Float64[np.ndarray, "N 3 3"], Float64[np.ndarray, "N 3 2"]]:
    """Covariance and sensitivity of triangulated points, in scene units (squared) and per pixel.

    Float64 [N, 3, 3], NaN where fewer than two of the images observed a point; float64 [N, 3, 2].
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
    """Standard deviation of a point's observations in each coordinate, pixels, float64 [N].

    The mean length of L residuals is sigma sqrt(pi / 2) sqrt((2 L - 3) / (2 L)), as the point took
    three of their 2 L degrees of freedom. Short tracks say little, so each variance is drawn
    towards the median's, as by an inverse chi-squared prior. Errors are negative where unknown.
    """
    free = np.maximum(2.0 * lengths - 3, 1)
    sigma = np.where(errors >= 0, errors, np.nan) * np.sqrt(2 / np.pi * 2 * lengths / free)
    usual = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 1.0
    sigma = np.where(np.isfinite(sigma), sigma, usual)
    return np.asarray(np.sqrt((free * sigma**2 + PRIOR * usual**2) / (free + PRIOR)))


def _filled(covariance: Float64[np.ndarray, "M 3 3"]) -> Float64[np.ndarray, "M 3 3"]:
    """Covariances, those that are unknown with the median variance of the others."""
    variance = np.trace(covariance, axis1=1, axis2=2) / 3
    unknown = ~np.isfinite(variance)
    usual = 0.0 if unknown.all() else float(np.median(variance[~unknown]))
    return np.where(unknown[:, None, None], usual * np.eye(3), covariance)
