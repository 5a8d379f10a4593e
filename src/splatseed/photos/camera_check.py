"""Detect stray cameras, whose poses must be wrong, and the near depth of a scene.

A camera *sees* the scene if about as many points project into its frame as into others, and if they
spread over some of it: a distant cloud shrinks to a dot. A *stray* does not see
the scene, and its distance from the cameras that do is a multiple of their extent and viewing
distance. Two rooms, a long walk or a drone over ground photographs therefore have no strays. The
*near depth* is the smallest, over the views, of the depth beyond which nine tenths of a view's
points lie.

Strays do not depend on the scene's scale, rotation or position; the near depth scales with it.
While at most half of the cameras are strays, neither depends on their number and positions, or on a
few distant points. Without points, a stray is far from nine tenths of the cameras.

V: number of views; P: number of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from splatseed.findings import Finding
from splatseed.photos.view import View, camera_views
from splatseed.photos.visibility import points_in_image
from splatseed.projection import camera_centers
from splatseed.sampling import strided
from splatseed.scene import Scene


@dataclass(frozen=True)
class CameraCheckSettings:
    """Thresholds of ``check_cameras``."""

    near_quantile: float = 0.1  # of a view's depths: nearer points may be reconstruction errors
    min_points: int = 20  # fewest points with a meaningful quantile; also enough to see the scene
    spread: tuple[float, float] = (0.05, 0.95)  # quantiles of pixel coordinates that span the area
    low_share: float = 0.1  # of the median count: a view with fewer, and few, points sees nothing
    min_share: float = 0.02  # of the median count: a view with fewer points sees nothing
    min_area: float = 0.003  # of the frame: points that cover less are a distant cloud
    stray_reach: float = 5.0  # distance of a stray, in extents of the cameras that see the scene
    min_cameras: int = 5  # without points: among fewer cameras none is a stray
    stray_share: float = 0.1  # without points: the largest share of strays, but at least one camera
    stray_distance: float = 10.0  # without points: distance of a stray, in extents of the others
    max_projections: int = 10_000_000  # points times views; beyond it points are subsampled
    min_sample: int = 10_000  # points that subsampling keeps
    max_names: int = 5  # strays named in a message


CAMERA_CHECK = CameraCheckSettings()


@dataclass(frozen=True, eq=False)
class CameraCheck:
    """Stray cameras and the near depth."""

    strays: Bool[np.ndarray, " V"]  # True for strays
    near_depth: float | None  # in the unit of the poses; None if no view sees a point


def check_cameras(views: Sequence[View], xyz: Float[np.ndarray, "P 3"]) -> CameraCheck:
    """Find stray cameras and the near depth of views of finite points, all in one frame."""
    centers = camera_centers([view.cam_from_world for view in views])
    if not views or not len(xyz):
        return CameraCheck(_distant_cameras(centers), None)
    limit = max(CAMERA_CHECK.min_sample, CAMERA_CHECK.max_projections // len(views))
    sample = np.asfortranarray(strided(xyz, limit), np.float64)
    count, area, near, middle = np.array([_point_statistics(view, sample) for view in views]).T
    median_count = np.median(count)
    min_count = max(
        1.0,
        CAMERA_CHECK.min_share * median_count,
        min(CAMERA_CHECK.min_points, CAMERA_CHECK.low_share * median_count),
    )
    seeing = (count >= min_count) & (area >= CAMERA_CHECK.min_area)
    if 2 * seeing.sum() >= len(views):
        middle_camera = np.median(centers[seeing], axis=0)
        distance = np.linalg.norm(centers - middle_camera, axis=1)
        reach = max(distance[seeing].max(), np.median(middle[seeing]))
        strays = ~seeing & (distance > CAMERA_CHECK.stray_reach * reach)
    else:
        strays = _distant_cameras(centers)
    known = ~strays & (count >= min(CAMERA_CHECK.min_points, count[~strays].max()))
    depth = float(near[known].min())
    return CameraCheck(strays, depth if np.isfinite(depth) else None)


def reference_points(scene: Scene) -> Float32[np.ndarray, "P 3"]:
    """Return the finite points that locate a scene: its own or, if it has none, those added."""
    points = scene.points.references
    return np.asarray(points.xyz[points.finite])


def stray_views(views: Sequence[View], xyz: Float[np.ndarray, "P 3"]) -> tuple[str, ...]:
    """Return the names of stray cameras; ``xyz`` are the scene's finite points, possibly none."""
    strays = check_cameras(views, xyz).strays
    return tuple(view.name for view, stray in zip(views, strays, strict=True) if stray)


def stray_cameras(scene: Scene) -> tuple[Finding, ...]:
    """Name a scene's stray cameras, if it has any."""
    return stray_findings(stray_views(camera_views(scene.images), reference_points(scene)))


def stray_findings(names: Sequence[str]) -> tuple[Finding, ...]:
    """Make the finding on stray cameras of these names, if there are any."""
    if not names:
        return ()
    text = f"The camera of {names[0]} is far from all others: check its pose, or leave it out."
    if len(names) > 1:
        listed = ", ".join(names[: CAMERA_CHECK.max_names])
        listed += (
            f" and {len(names) - CAMERA_CHECK.max_names:,} more"
            if len(names) > CAMERA_CHECK.max_names
            else ""
        )
        text = f"{len(names):,} cameras are far from all others: check their poses, or leave them"
        text = f"{text} out ({listed})."
    return (Finding("stray-cameras", text, subjects=tuple(names)),)


def _point_statistics(
    view: View, xyz: Float64[np.ndarray, "P 3"]
) -> tuple[float, float, float, float]:
    """Return number, area (as a share of the image), near and median depth of visible points."""
    points = points_in_image(view.camera, xyz)
    if not len(points.point_idx):
        return 0.0, 0.0, np.inf, np.inf
    low, high = np.quantile(points.uv, CAMERA_CHECK.spread, axis=0)
    width, height = (high - low) / [view.width, view.height]
    near, middle = np.quantile(points.depth, [CAMERA_CHECK.near_quantile, 0.5])
    return float(len(points.point_idx)), float(width * height), float(near), float(middle)


def _distant_cameras(centers: Float64[np.ndarray, "V 3"]) -> Bool[np.ndarray, " V"]:
    """Return a mask of the cameras that are far from nine tenths of all cameras."""
    if len(centers) < CAMERA_CHECK.min_cameras:
        return np.zeros(len(centers), bool)
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    # The nearest nine tenths cannot be strays; `reach` is the distance of their farthest.
    usual = max(1, len(centers) - max(1, round(CAMERA_CHECK.stray_share * len(centers))))
    reach = np.partition(distances, usual - 1)[usual - 1]
    rounding = 1e-9 * float(np.abs(np.median(centers, axis=0)).max())
    return np.asarray((distances > CAMERA_CHECK.stray_distance * reach) & (reach > rounding))
