"""How much of the same surfaces photographs with known poses show.

Depths come from a first look: each view is matched with a few neighbours, and features are
triangulated by the relative pose that the matches themselves give, so that rotations may be off by
degrees; only the length of the baseline is taken from the given poses.

Notation: V views in the order of their names; a pair is two of their rows. ``seen[i]`` are world
points that view i shows. The *overlap* of two views, 0 to 1, is the geometric mean of the shares of
each one's points that the other shows at an angle and a size at which features match.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.visibility import points_in_image
from splatseed.projection import denormalized, pixel_centers
from splatseed.sampling import strided
from splatseed.sfm.first_look import Agreement, Pair

Points: TypeAlias = Float64[np.ndarray, "M 3"]


@dataclass(frozen=True)
class _OverlapSettings:
    """Pairs of the first look, and when features of the same surface match."""

    successors: int = 2
    """Following views by name: most captures are walks."""
    near: int = 3
    """Views nearby that look the same way."""
    min_angle: float = 1.0
    """Degrees between rays to a point: less gives no depth."""
    min_points: int = 10
    """A view with fewer points has the depths of the views nearby."""
    angles: tuple[float, float] = (20.0, 60.0)
    """Degrees between rays to a point: SIFT matches up to the first, never beyond the second."""
    sizes: tuple[float, float] = (2.0, 5.0)
    """Ratio of a surface's sizes in two views: likewise."""
    points: int = 48
    """Points per view that are projected: more do not change the order of overlaps."""
    common: float = 64.0
    """Common features, of the ``FIRST_LOOK.features`` largest, of two views of overlap 1."""


OVERLAP = _OverlapSettings()


def first_pairs(cameras: Sequence[Camera]) -> list[Pair]:
    """Choose the pairs of the first look, sorted: successors by name, and nearby views."""
    count, pairs = len(cameras), set[Pair]()
    near = choose_by_pose(np.stack([c.cam_from_world for c in cameras]), OVERLAP.near)
    for i in range(count):
        others = [*range(i + 1, min(i + 1 + OVERLAP.successors, count)), *near[i].tolist()]
        pairs |= {(min(i, j), max(i, j)) for j in others if j >= 0}
    return sorted(pairs)


def points_of_matches(
    rays: tuple[Float64[np.ndarray, "M 2"], Float64[np.ndarray, "M 2"]],
    second_from_first: Float64[np.ndarray, "3 4"],
    cameras: tuple[Camera, Camera],
) -> tuple[Points, Points]:
    """Triangulate matches of two views; return the world points by the pose of each view.

    Args:
        rays: Matching points on the planes at depth 1 of the two views, undistorted.
        second_from_first: Their relative pose by the matches, of any scale.
        cameras: The views at the given poses, whose distance gives the scale.
    """
    rotation, translation = second_from_first[:, :3], second_from_first[:, 3]
    ones = np.ones((len(rays[0]), 1))
    a, b = np.hstack([rays[0], ones]) @ rotation.T, np.hstack([rays[1], ones])
    # The depths z of the midpoint solve z_a a + t = z_b b in least squares (a, b: rays in view 2).
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    at, bt, det = a @ translation, b @ translation, aa * bb - ab**2
    wide = det > np.sin(np.radians(OVERLAP.min_angle)) ** 2 * aa * bb
    det = np.where(wide, det, 1.0)
    z_a, z_b = (ab * bt - bb * at) / det, (aa * bt - ab * at) / det
    baseline = float(np.linalg.norm(cameras[0].center - cameras[1].center))
    length = float(np.linalg.norm(translation))
    scale = baseline / length if length else 0.0  # a camera that only turned
    good = wide & (z_a > 0) & (z_b > 0) & (scale > 0)
    return tuple(  # type: ignore[return-value]
        _world(camera, points[good], scale * depth[good])
        for camera, points, depth in zip(cameras, rays, (z_a, z_b), strict=True)
    )


def _world(
    camera: Camera, rays: Float64[np.ndarray, "M 2"], depth: Float64[np.ndarray, " M"]
) -> Points:
    return camera.unproject(denormalized(camera.K, rays), depth)


def overlaps(cameras: Sequence[Camera], seen: Sequence[Points]) -> Float64[np.ndarray, "V V"]:
    """Return the overlap of each two views; 0 on the diagonal."""
    seen = _completed(cameras, seen)
    thinned = [strided(points, OVERLAP.points) for points in seen]
    count = np.array([len(points) for points in thinned])
    owner = np.repeat(np.arange(len(cameras)), count)
    xyz = np.concatenate(thinned)
    to_owner = np.stack([camera.center for camera in cameras])[owner] - xyz
    # A surface's size in a view is the focal length, in widths of the view, over the distance.
    focal = np.array([camera.K[0, 0] / camera.width for camera in cameras])
    size = focal[owner] / np.linalg.norm(to_owner, axis=1)
    shown = np.zeros((len(cameras), len(cameras)))
    by_column = np.asfortranarray(xyz)
    for j, camera in enumerate(cameras):
        rows = points_in_image(camera, by_column).point_idx
        to_camera = camera.center - xyz[rows]
        distance = np.linalg.norm(to_camera, axis=1)
        cosine = (to_camera * to_owner[rows]).sum(axis=1) * size[rows] / focal[owner[rows]]
        angle = np.degrees(np.arccos(np.clip(cosine / distance, -1, 1)))
        ratio = np.abs(np.log(focal[j] / distance / size[rows]))
        weight = _ramp(angle, *OVERLAP.angles) * _ramp(ratio, *np.log(OVERLAP.sizes))
        shown[:, j] = np.bincount(owner[rows], weight, len(cameras)) / count
    overlap = np.sqrt(shown * shown.T)
    np.fill_diagonal(overlap, 0.0)
    return np.asarray(overlap)


def expected_agreement(overlap: Float64[np.ndarray, "V V"]) -> Agreement:
    """Return how many of their largest features views of these overlaps have in common."""
    return np.rint(OVERLAP.common * overlap).astype(np.int32)


def _completed(cameras: Sequence[Camera], seen: Sequence[Points]) -> list[Points]:
    """Give views with few points a grid of them at the median depth of the nearest view with more.

    Without any, depths are the median distance of the cameras.
    """
    centers = np.stack([camera.center for camera in cameras])
    known = np.array([len(points) >= OVERLAP.min_points for points in seen])
    apart = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    spread = float(np.median(apart)) or 1.0
    depths = np.array(
        [
            np.median((points - center) @ camera.cam_from_world[2, :3]) if enough else spread
            for camera, points, center, enough in zip(cameras, seen, centers, known, strict=True)
        ]
    )
    completed = list(seen)
    for i in np.flatnonzero(~known).tolist():
        if known.any():
            from_here = np.linalg.norm(centers[known] - centers[i], axis=1)
            depths[i] = depths[known][from_here.argmin()]
        relative = pixel_centers(6, 8).reshape(-1, 2) / [8, 6]
        uv = relative * [cameras[i].width, cameras[i].height]
        completed[i] = cameras[i].unproject(uv, np.full(len(uv), depths[i]))
    return completed


def _ramp(values: Float64[np.ndarray, " M"], good: float, bad: float) -> Float64[np.ndarray, " M"]:
    """Fall from 1 to 0 between two limits."""
    return np.asarray(np.clip((bad - values) / (bad - good), 0.0, 1.0))
