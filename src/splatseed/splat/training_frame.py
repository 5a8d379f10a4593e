"""The frame in which Gaussians are trained and rendered.

The centroid of the cameras is at 0 and the farthest camera at distance 1:
``x_train = scale (x_world - origin)``. Stray cameras (``photos.camera_check``) are excluded. The
near plane follows from the depths of visible points rather than from the distances between cameras,
which on a long walk are a thousand times as large.

Runs from different seeds share one frame: origin and scale depend on the training cameras, strays
and near plane on the scene's own points (on new points only if it has none of its own). Single
precision suffices in this frame even far from the world's origin.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from splatseed.photos.camera_check import check_cameras
from splatseed.photos.view import NEAR_PLANE, View
from splatseed.pointcloud import PointCloud
from splatseed.projection import camera_centers
from splatseed.splat.gaussians import VISIBLE_LOGIT, Gaussians

SCENE_SCALE = 1.1
"""Scene size in the training frame, for strategies and the learning rate of positions: the extent
of the cameras plus a tenth, as in 3DGS."""
NEAR_SHARE = 0.01
"""Near plane as a share of the near depth (``photos.camera_check``). Surfaces are seldom ten times
nearer than the near depth; a Gaussian a hundred times nearer covers the image of one view and is
invisible in all others."""
NO_POINTS = np.empty((0, 3), np.float32)


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """A translation and uniform scaling from world to training coordinates."""

    origin: Float64[np.ndarray, " 3"]  # world coordinates of the training origin
    scale: float  # training units per world unit
    near: float = NEAR_PLANE  # the near plane, in training units
    strays: tuple[str, ...] = ()  # names of the excluded views

    @property
    def near_depth(self) -> float:
        """The near depth (``photos.camera_check``) in training units."""
        return self.near / NEAR_SHARE

    def points_from_world(self, xyz: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
        """Transform points from world to training coordinates."""
        return np.asarray((xyz.astype(np.float64) - self.origin) * self.scale, np.float32)

    def cloud_from_world(self, cloud: PointCloud) -> PointCloud:
        """Transform a cloud to training coordinates: positions and sizes; normals stay."""
        moved = cloud.replace(xyz=self.points_from_world(cloud.xyz))
        if cloud.sizes is None:
            return moved
        limits = np.finfo(np.float32)
        sizes = np.clip(cloud.sizes.astype(np.float64) * self.scale, limits.tiny, limits.max)
        return moved.replace(sizes=sizes)

    def gaussians_from_world(self, gaussians: Gaussians) -> Gaussians:
        """Transform Gaussians from world to training coordinates."""
        return dataclasses.replace(
            gaussians,
            means=self.points_from_world(gaussians.means),
            scales=gaussians.scales + np.float32(np.log(self.scale)),  # logarithms
        )

    def points_to_world(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Transform points from training to world coordinates."""
        return np.asarray(xyz.astype(np.float64) / self.scale + self.origin)

    def gaussians_to_world(self, gaussians: Gaussians) -> Gaussians:
        """Transform Gaussians from training to world coordinates, as float32."""
        return dataclasses.replace(
            gaussians,
            means=self.points_to_world(gaussians.means).astype(np.float32),
            scales=gaussians.scales - np.float32(np.log(self.scale)),
        )

    def view(self, view: View) -> View:
        """Return the view with its pose in the training frame, and the frame's near plane."""
        cam_from_train = np.array(view.cam_from_world)
        rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
        # x_cam = R x + t = (R x_train + s (R o + t)) / s: the same image, depths times s.
        cam_from_train[:3, 3] = self.scale * (rotation @ self.origin + translation)
        return dataclasses.replace(view.posed(cam_from_train), near=self.near)


def frame_of_model(
    views: Sequence[View], points: Float[np.ndarray, "P 3"], gaussians: Gaussians | None
) -> TrainingFrame:
    """Return the training frame to render a model in.

    Visible Gaussians stand in for the scene's points if it has none.
    """
    if len(points) or gaussians is None:
        return training_frame(views, points)
    shown = gaussians.opacities > VISIBLE_LOGIT
    return training_frame(views, gaussians.means[shown & np.isfinite(gaussians.means).all(axis=1)])


def training_frame(
    views: Sequence[View], points: Float[np.ndarray, "P 3"] = NO_POINTS
) -> TrainingFrame:
    """Return the frame of these cameras, without strays; a mere translation if all coincide.

    ``points`` locate the scene and are finite: ``PointCloud.references``, or means of Gaussians.
    """
    centers = camera_centers([view.cam_from_world for view in views])
    check = check_cameras(views, points)
    usual = centers[~check.strays]
    origin = usual.mean(axis=0)
    extent = float(np.linalg.norm(usual - origin, axis=1).max())
    rounding = 1e-9 * float(np.abs(usual).max())  # of coincident cameras
    scale = 1.0 / extent if extent > rounding else 1.0
    near = NEAR_PLANE if check.near_depth is None else NEAR_SHARE * check.near_depth * scale
    names = (view.name for view, stray in zip(views, check.strays, strict=True) if stray)
    return TrainingFrame(origin, scale, near, tuple(names))
