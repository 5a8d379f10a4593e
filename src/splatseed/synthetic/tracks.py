"""Simulated Structure-from-Motion points of rendered photographs.

Notation: V views, N points, T observations; view ``view_idx[t]`` observes point ``point_idx[t]`` at
pixel ``uv[t]``, sorted by point, then view. Candidates are image corners, so that texture
determines density. Positions are least-squares triangulations of noisy observations, so that, as in
real models, errors are largest along viewing rays and for short tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy import ndimage

from splatseed.camera import Camera
from splatseed.projection import in_camera, pixel_jacobians
from splatseed.synthetic.room import visible
from splatseed.synthetic.surfaces import Surface

Points = Float64[np.ndarray, "N 3"]
Maps = Float32[np.ndarray, "V H W"]
Indices = Int64[np.ndarray, " T"]
Pixels = Float64[np.ndarray, "T 2"]

MIN_STRENGTH = 6e-5
"""Smallest corner strength of a feature, for grey values 0..1: between textureless and textured
surfaces."""

MERGE_PIXELS = 2.4
"""Corners of different views within this many pixels in 3D are one point."""

FULL_STRENGTH = 2e-3
"""Strength from which corners are always candidates; probability is proportional below."""

MIN_COSINE = 0.25
"""Smallest cosine between ray and normal for matching: 75 degrees."""

PIXEL_SIGMA, MISMATCH_NOISE = 0.5, 2.5
"""Standard deviation of observations per axis, px, and its factor for mismatches."""
OUTLIER_SHARE = 0.025
"""Share of mismatched points, wrong by 15-80% of their depth."""
NEWTON_STEPS = 4
MIN_TRACK = 3
"""Fewest views of a point, except for mismatches."""


@dataclass(frozen=True, eq=False)
class TrackedPoints:
    """Triangulated points and their observations."""

    xyz: Points
    errors: Float64[np.ndarray, " N"]  # mean reprojection error of each point, px
    outliers: Bool[np.ndarray, " N"]  # mismatched points
    point_idx: Indices  # point of each observation, ascending
    view_idx: Indices  # view of each observation
    uv: Pixels  # pixel of each observation


def _corner_strength(image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Return the smaller eigenvalue of the grey image's structure tensor, [H, W].

    Source: Shi and Tomasi, Good Features to Track, 1994.
    """
    gray = image.astype(np.float32).mean(axis=2) / 255.0
    gx = ndimage.gaussian_filter(gray, 0.8, order=(0, 1))
    gy = ndimage.gaussian_filter(gray, 0.8, order=(1, 0))
    xx, yy, xy = (ndimage.gaussian_filter(g, 1.2) for g in (gx * gx, gy * gy, gx * gy))
    # The smaller eigenvalue of [[xx, xy], [xy, yy]]
    return np.asarray((xx + yy) / 2 - np.hypot((xx - yy) / 2, xy), np.float32)


def _find_corners(strength: Float32[np.ndarray, "H W"]) -> Int64[np.ndarray, "M 2"]:
    """Return row and column of local maxima above ``MIN_STRENGTH``, [M, 2]."""
    peak = (strength == ndimage.maximum_filter(strength, 3)) & (strength > MIN_STRENGTH)
    peak[:3], peak[-3:], peak[:, :3], peak[:, -3:] = (False,) * 4  # filters need neighbours
    rows, cols = np.nonzero(peak)
    return np.stack([rows, cols], axis=1)


def track_points(
    surfaces: Surface,
    cameras: Sequence[Camera],
    images: UInt8[np.ndarray, "V H W 3"],
    depths: Maps,
    rng: np.random.Generator,
) -> TrackedPoints:
    """Find corners, track them through the views, and triangulate them.

    ``rng`` draws detections, noise and mismatches; depth 0 means no surface.
    """
    strengths = np.stack([_corner_strength(image) for image in images])
    truth = _candidates(cameras, strengths, depths, rng)
    point_idx, view_idx = _observe(surfaces, cameras, strengths, truth, rng)
    keep = np.bincount(point_idx, minlength=len(truth)) >= MIN_TRACK
    truth, (point_idx, view_idx) = truth[keep], _renumber(keep, point_idx, view_idx)

    outliers = rng.random(len(truth)) < OUTLIER_SHARE
    truth, kept = _displace(cameras, truth, outliers, point_idx, view_idx, rng)
    # A mismatch in a single view could not be triangulated.
    keep = np.bincount(point_idx[kept], minlength=len(truth)) >= 2
    truth, outliers = truth[keep], outliers[keep]
    point_idx, view_idx = _renumber(keep, point_idx[kept], view_idx[kept])
    sigma = PIXEL_SIGMA * rng.lognormal(-0.1, 0.45, len(truth))
    sigma[outliers] *= MISMATCH_NOISE
    uv = _project(cameras, truth, point_idx, view_idx)
    uv += rng.normal(size=uv.shape) * sigma[point_idx, None]
    xyz = _triangulate(cameras, truth, point_idx, view_idx, uv)
    residual = np.linalg.norm(uv - _project(cameras, xyz, point_idx, view_idx), axis=1)
    errors = np.bincount(point_idx, residual) / np.bincount(point_idx)
    return TrackedPoints(xyz, errors, outliers, point_idx, view_idx, uv)


def _candidates(
    cameras: Sequence[Camera], strengths: Maps, depths: Maps, rng: np.random.Generator
) -> Points:
    """Return exact surface points at the corners of all views, with near-duplicates merged."""
    per_view = []
    for camera, strength, depth in zip(cameras, strengths, depths, strict=True):
        corners = _find_corners(strength)
        at_corner = strength[corners[:, 0], corners[:, 1]]
        chosen = rng.random(len(corners)) < at_corner / FULL_STRENGTH
        per_view.append(_unproject_corners(camera, corners[chosen], depth))
    xyz = np.concatenate([points for points, _ in per_view])
    footprint = np.median(np.concatenate([size for _, size in per_view]))
    cells = np.floor(xyz / (MERGE_PIXELS * footprint)).astype(np.int64)
    return np.asarray(xyz[np.sort(np.unique(cells, axis=0, return_index=True)[1])])


def _unproject_corners(
    camera: Camera, corners: Int64[np.ndarray, "M 2"], depth: Float32[np.ndarray, "H W"]
) -> tuple[Float64[np.ndarray, "K 3"], Float64[np.ndarray, " K"]]:
    """Return surface points at corners, and the size of a pixel there.

    Silhouette corners belong to the front surface, so each moves to the nearest surface in its
    5 x 5 window.
    """
    shift = np.mgrid[-2:3, -2:3].reshape(2, -1).T
    window = corners[:, None] + shift  # [M, 25, 2]
    z = depth[window[..., 0], window[..., 1]].astype(np.float64)
    best = np.where(z > 0, z, np.inf).argmin(axis=1)
    rows = np.arange(len(corners))
    z, pixel = z[rows, best], window[rows, best]
    hit = z > 0
    return camera.unproject(pixel[hit][:, ::-1] + 0.5, z[hit]), z[hit] / camera.K[0, 0]


def _observe(
    surfaces: Surface,
    cameras: Sequence[Camera],
    strengths: Maps,
    xyz: Points,
    rng: np.random.Generator,
) -> tuple[Indices, Indices]:
    """Draw which views detect which points: (point_idx, view_idx), sorted by point, then view.

    A detected point is visible, not too oblique, and a corner of the view's image. Detection is
    then random, with a repeatability per point.
    """
    repeatability = rng.beta(1.5, 3.5, len(xyz))
    normals = surfaces.normals(xyz)
    detected = np.zeros((len(xyz), len(cameras)), bool)
    for v, (camera, strength) in enumerate(zip(cameras, strengths, strict=True)):
        seen = np.flatnonzero(visible(surfaces, camera, xyz))
        uv, _ = camera.project(xyz[seen])
        column, row = np.floor(uv).astype(np.int64).T
        strong = ndimage.maximum_filter(strength, 3)[row, column] > MIN_STRENGTH
        ray = xyz[seen] - camera.center
        cosine = np.abs(np.einsum("ij,ij->i", ray, normals[seen])) / np.linalg.norm(ray, axis=1)
        repeats = rng.random(len(seen)) < repeatability[seen]
        detected[seen, v] = strong & (cosine > MIN_COSINE) & repeats
    point_idx, view_idx = np.nonzero(detected)
    return point_idx, view_idx


def _renumber(
    keep: Bool[np.ndarray, " N"], point_idx: Indices, view_idx: np.ndarray
) -> tuple[Int64[np.ndarray, " S"], Int64[np.ndarray, " S"]]:
    """Keep the observations of kept points, and renumber the points."""
    mine = keep[point_idx]
    return (np.cumsum(keep) - 1)[point_idx[mine]], view_idx[mine]


def _displace(
    cameras: Sequence[Camera],
    xyz: Points,
    outliers: Bool[np.ndarray, " N"],
    point_idx: Indices,
    view_idx: Indices,
    rng: np.random.Generator,
) -> tuple[Points, Bool[np.ndarray, " T"]]:
    """Move mismatches along the ray of their first view, and limit their tracks to three views.

    Returns the positions, and a mask of observations whose point is still in the image.
    """
    first = np.searchsorted(point_idx, np.arange(len(xyz)))
    eyes = np.stack([camera.center for camera in cameras])[view_idx[first]]
    factor = np.exp(rng.choice([-1.0, 1.0], len(xyz)) * rng.uniform(0.15, 0.6, len(xyz)))
    moved = np.where(outliers[:, None], eyes + factor[:, None] * (xyz - eyes), xyz)
    uv = _project(cameras, moved, point_idx, view_idx)
    limits = np.array([[camera.width, camera.height] for camera in cameras])[view_idx]
    inside = ((uv >= 0) & (uv < limits)).all(axis=1)  # NaN behind the camera compares false
    early = np.arange(len(point_idx)) - first[point_idx] < 3
    return moved, ~outliers[point_idx] | (inside & early)


def _project(
    cameras: Sequence[Camera], xyz: Points, point_idx: Indices, view_idx: Indices
) -> Pixels:
    uv = np.empty((len(point_idx), 2))
    for v, camera in enumerate(cameras):
        mine = view_idx == v
        uv[mine] = camera.project(xyz[point_idx[mine]])[0]
    return uv


def _triangulate(
    cameras: Sequence[Camera], start: Points, point_idx: Indices, view_idx: Indices, uv: Pixels
) -> Points:
    """Triangulate all points by Gauss-Newton from ``start``.

    Each step solves (sum JᵀJ) dx = sum Jᵀ r, with J the derivative of the pixel by the point.
    """
    poses = np.stack([camera.cam_from_world for camera in cameras])[view_idx]
    focals = np.stack([np.diag(camera.K)[:2] for camera in cameras])[view_idx]
    starts = np.searchsorted(point_idx, np.arange(len(start)))
    xyz = start
    for _ in range(NEWTON_STEPS):
        jacobian = pixel_jacobians(focals, poses, in_camera(poses, xyz[point_idx]))
        residual = uv - _project(cameras, xyz, point_idx, view_idx)
        normal = np.add.reduceat(np.einsum("tki,tkj->tij", jacobian, jacobian), starts)
        right = np.add.reduceat(np.einsum("tki,tk->ti", jacobian, residual), starts)
        xyz = xyz + np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return xyz
