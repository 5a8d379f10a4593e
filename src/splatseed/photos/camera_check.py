"""What cameras see of a scene's points: the depth at which it begins, and cameras that stray.

Notation: V views; P points, which show where the scene is. A camera *sees* the scene if, within its
frame, there are about as many points as in the others', spread over some of the picture: a cloud
that is far away shrinks to a dot. A *stray* sees nothing of it and stands ``STRAY_REACH`` times
farther from the cameras that do than these reach or look: its pose must be wrong. So neither two
rooms, nor a long walk, nor a drone over ground photographs has strays. The *near depth* is the
smallest, over the views, of the depth beyond which nine tenths of a view's points lie.

Promise: both scale with the scene, and turn and move with it; as long as at most half of the
cameras are strays, how many there are, where they stand, and a few points far out change neither.
Where points do not tell, a stray is far from nine tenths of the cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from splatseed.photos.view import View, camera_views
from splatseed.photos.visibility import points_in_image
from splatseed.scene import Scene

NEAR_QUANTILE, LEAST_POINTS = 0.1, 20
"""The share of a view's points that may be reconstruction errors in front of its camera, and the
fewest of which a share can be taken; where no view has as many, the view with most counts alone."""
SPREAD = (0.05, 0.95)  # quantiles of image coordinates between which the points' area is measured
FEW_SHARE, LEAST_SHARE, LEAST_AREA = 0.1, 0.02, 0.003
"""A camera does not see the scene if, compared with the median over the cameras, it sees less than
the first of its points, and fewer than ``LEAST_POINTS``, or less than the second; or if they fill
less of the frame than the third."""
STRAY_REACH = 5.0
MIN_CAMERAS, STRAY_SHARE, STRAY_DISTANCE = 5, 0.1, 10.0
"""Without points: among fewer cameras than the first, none is a stray; among more, at most this
share of them, but always one, can be. A stray is this many times farther from the cameras' median
than the farthest camera that cannot be one."""
MOST_PROJECTIONS, LEAST_SAMPLE = 10_000_000, 10_000
"""Beyond the first, points times views, every n-th point is taken, but no fewer than the second."""
NAMED = 5  # strays named in a note


@dataclass(frozen=True, eq=False)
class CameraCheck:
    """What views see of a scene."""

    strays: Bool[np.ndarray, " V"]
    near: float | None  # the near depth, in the unit of the poses; None without points in sight


def check_cameras(views: Sequence[View], xyz: Float[np.ndarray, "P 3"]) -> CameraCheck:
    """What views see of finite points, both in one frame."""
    centers = camera_centers(views)
    if not views or not len(xyz):
        return CameraCheck(_far_from_most(centers), None)
    most = max(LEAST_SAMPLE, MOST_PROJECTIONS // len(views))
    sample = np.asfortranarray(xyz[:: -(-len(xyz) // most)], np.float64)
    count, area, near, middle = np.array([_measured(view, sample) for view in views]).T
    usual = np.median(count)
    fewest = max(1.0, LEAST_SHARE * usual, min(LEAST_POINTS, FEW_SHARE * usual))
    seeing = (count >= fewest) & (area >= LEAST_AREA)
    if 2 * seeing.sum() >= len(views):
        around = np.median(centers[seeing], axis=0)
        distance = np.linalg.norm(centers - around, axis=1)
        reach = max(distance[seeing].max(), np.median(middle[seeing]))
        strays = ~seeing & (distance > STRAY_REACH * reach)
    else:
        strays = _far_from_most(centers)
    known = ~strays & (count >= min(LEAST_POINTS, count[~strays].max()))
    depth = float(near[known].min())
    return CameraCheck(strays, depth if np.isfinite(depth) else None)


def reference_points(scene: Scene) -> Float32[np.ndarray, "P 3"]:
    """The finite points that show where a scene is: its own, or if it has none, those added."""
    points = scene.points.references
    return np.asarray(points.xyz[points.finite])


def stray_views(views: Sequence[View], xyz: Float[np.ndarray, "P 3"]) -> tuple[str, ...]:
    """Names of the views whose cameras are strays, in a scene of these finite points, if any."""
    strays = check_cameras(views, xyz).strays
    return tuple(view.name for view, stray in zip(views, strays, strict=True) if stray)


def stray_camera_notes(scene: Scene) -> tuple[str, ...]:
    """A note for the user that names a scene's stray cameras; none without them."""
    return format_stray_note(stray_views(camera_views(scene.images), reference_points(scene)))


def format_stray_note(names: Sequence[str]) -> tuple[str, ...]:
    """A note for the user about stray cameras of these names; none without them."""
    if not names:
        return ()
    note = f"The camera of {names[0]} is far from all others: check its pose, or leave it out."
    if len(names) > 1:
        listed = ", ".join(names[:NAMED])
        listed += f" and {len(names) - NAMED:,} more" if len(names) > NAMED else ""
        note = f"{len(names):,} cameras are far from all others: check their poses, or leave them"
        note = f"{note} out ({listed})."
    return (note,)


def camera_centers(views: Sequence[View]) -> Float64[np.ndarray, "V 3"]:
    """Where the cameras stand."""
    poses = np.array([view.cam_from_world for view in views]).reshape(-1, 4, 4)
    # Written-out sums: BLAS's order varies with threads.
    rotation, shift = poses[:, :3, :3], poses[:, :3, 3]
    return np.asarray(-(rotation * shift[:, :, None]).sum(axis=1))


def _measured(view: View, xyz: Float64[np.ndarray, "P 3"]) -> tuple[float, float, float, float]:
    """Number, share of the image's area, near and median depth of the points within the image."""
    points = points_in_image(view.camera, xyz)
    if not len(points.point_idx):
        return 0.0, 0.0, np.inf, np.inf
    low, high = np.quantile(points.uv, SPREAD, axis=0)
    width, height = (high - low) / [view.width, view.height]
    near, middle = np.quantile(points.depth, [NEAR_QUANTILE, 0.5])
    return float(len(points.point_idx)), float(width * height), float(near), float(middle)


def _far_from_most(centers: Float64[np.ndarray, "V 3"]) -> Bool[np.ndarray, " V"]:
    """Which cameras are far from nine tenths of them."""
    if len(centers) < MIN_CAMERAS:
        return np.zeros(len(centers), bool)
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    # The nearest nine tenths of the cameras can be no strays: the distance of their farthest.
    usual = max(1, len(centers) - max(1, round(STRAY_SHARE * len(centers))))
    reach = np.partition(distances, usual - 1)[usual - 1]
    rounding = 1e-9 * float(np.abs(np.median(centers, axis=0)).max())
    return np.asarray((distances > STRAY_DISTANCE * reach) & (reach > rounding))
