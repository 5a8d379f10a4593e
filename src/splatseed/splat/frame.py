"""The frame that training works in: the cameras' centroid at 0, the farthest camera at distance 1.

Notation: ``x_train = scale (x_world - origin)``; a *stray* camera is so far from all others that
its pose must be wrong. Promise: the frame depends on the training cameras only, so that runs from
different seeds are compared in one frame, and strays do not affect it; there is no rotation, so
quaternions and spherical harmonics stay the same; single precision suffices for distant origins.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from splatseed.pointcloud import PointCloud
from splatseed.splat.gaussians import Gaussians
from splatseed.views.view import View

SCENE_SCALE = 1.1
"""Scene size for the strategies and the learning rate of positions: the cameras' extent plus a
tenth, as in 3DGS."""
STRAY_SHARE = 0.1
"""At most this share of the cameras, but always one, can be strays."""
STRAY_DISTANCE = 10.0
"""A stray is this many times farther from the cameras' median than the farthest camera that cannot
be one."""
MIN_CAMERAS = 5
"""With fewer cameras, none can be called a stray."""


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """A similarity without rotation.

    Args:
        origin: World point that becomes 0, float64 [3].
        scale: Training units per world unit.
    """

    origin: Float64[np.ndarray, " 3"]
    scale: float

    def points_from_world(self, xyz: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
        """World points in the training frame."""
        return np.asarray((xyz.astype(np.float64) - self.origin) * self.scale, np.float32)

    def cloud_from_world(self, cloud: PointCloud) -> PointCloud:
        """A cloud of the world in the training frame: positions and sizes change, normals stay."""
        moved = cloud.replace(xyz=self.points_from_world(cloud.xyz))
        if cloud.sizes is None:
            return moved
        limits = np.finfo(np.float32)
        sizes = np.clip(cloud.sizes.astype(np.float64) * self.scale, limits.tiny, limits.max)
        return moved.replace(sizes=sizes)

    def points_to_world(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Points of the training frame in the world."""
        return np.asarray(xyz.astype(np.float64) / self.scale + self.origin)

    def gaussians_to_world(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the training frame in the world (float32 there: see the promise)."""
        return dataclasses.replace(
            gaussians,
            means=self.points_to_world(gaussians.means).astype(np.float32),
            # Scales are logarithms: division becomes subtraction.
            scales=gaussians.scales - np.float32(np.log(self.scale)),
        )

    def view(self, view: View) -> View:
        """The same view, its camera posed in the training frame."""
        cam_from_train = view.cam_from_world.copy()
        rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
        # x_cam = R x + t = (R x_train + s (R o + t)) / s: the same image, depths times s.
        cam_from_train[:3, 3] = self.scale * (rotation @ self.origin + translation)
        return dataclasses.replace(view, cam_from_world=cam_from_train)


def training_frame(views: Sequence[View]) -> TrainingFrame:
    """The frame of these cameras without the strays; only a translation if all are in one place."""
    centers = _centers(views)
    near = centers[~_is_stray(centers)]
    origin = near.mean(axis=0)
    extent = float(np.linalg.norm(near - origin, axis=1).max())
    # Rounding leaves a little extent even if all cameras are in one place.
    rounding = 1e-9 * float(np.abs(near).max())
    return TrainingFrame(origin, 1.0 / extent if extent > rounding else 1.0)


def stray_views(views: Sequence[View]) -> tuple[str, ...]:
    """Names of the views whose cameras are strays: see ``STRAY_DISTANCE``."""
    strays = _is_stray(_centers(views))
    return tuple(view.name for view, stray in zip(views, strays, strict=True) if stray)


def stray_note(name: str) -> str:
    """The note for the user about a stray camera."""
    return f"The camera of {name} is far from all others: check its pose, or leave it out."


def _centers(views: Sequence[View]) -> Float64[np.ndarray, "V 3"]:
    """The cameras' positions in the world."""
    return np.array([-view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3] for view in views])


def _is_stray(centers: Float64[np.ndarray, "V 3"]) -> Bool[np.ndarray, " V"]:
    """Which cameras are far from all others: at most a tenth of them, or one."""
    if len(centers) < MIN_CAMERAS:
        return np.zeros(len(centers), bool)
    distances = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    # The nearest nine tenths of the cameras can be no strays.
    usual = max(1, len(centers) - max(1, round(STRAY_SHARE * len(centers))))
    # The farthest of those that cannot be strays.
    reach = np.partition(distances, usual - 1)[usual - 1]
    rounding = 1e-9 * float(np.abs(np.median(centers, axis=0)).max())
    return np.asarray((distances > STRAY_DISTANCE * reach) & (reach > rounding))
