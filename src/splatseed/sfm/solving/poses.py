"""Poses of many cameras as arrays: how far two sets differ, and the similarity between them.

Notation: N cameras; ``rotations`` [N, 3, 3] are the upper left of ``cam_from_world`` in OpenCV
axes, ``centers`` [N, 3] are in scene units. A *turn* is the angle between two rotations of one
camera in degrees, a *shift* the distance of its two centres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.camera import quat_from_rotation
from splatseed.scene import Image

_ROUNDS = 5  # of fitting the similarity and the noise in turn
_LEAST_NOISE = 1e-9  # of the spread, and in radians: equal poses have none
_TYPICAL = 1.54  # median length of a 3-vector of standard normal numbers


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of N cameras.

    Args:
        rotations: cam_from_world, float64 [N, 3, 3].
        centers: In the world, scene units, float64 [N, 3].
    """

    rotations: Float64[np.ndarray, "N 3 3"]
    centers: Float64[np.ndarray, "N 3"]

    def only(self, chosen: Bool[np.ndarray, " N"]) -> Poses:
        """The poses of the ``chosen`` cameras."""
        return Poses(self.rotations[chosen], self.centers[chosen])

    def with_new(self, chosen: Bool[np.ndarray, " N"], new: Poses) -> Poses:
        """These poses, but ``new`` ones for the ``chosen`` cameras."""
        rotations, centers = self.rotations.copy(), self.centers.copy()
        rotations[chosen], centers[chosen] = new.rotations, new.centers
        return Poses(rotations, centers)


def poses_of(images: Sequence[Image]) -> Poses:
    """The poses of ``images``, in their order."""
    cameras = [image.camera for image in images]
    return Poses(
        np.array([camera.cam_from_world[:3, :3] for camera in cameras]),
        np.array([camera.center for camera in cameras]),
    )


def with_poses(images: Sequence[Image], poses: Poses) -> list[Image]:
    """The ``images`` with other poses."""
    return [
        replace(image, quat=quat_from_rotation(rotation), translation=-rotation @ center)
        for image, rotation, center in zip(images, poses.rotations, poses.centers, strict=True)
    ]


def turns(a: Poses, b: Poses) -> Float64[np.ndarray, " N"]:
    """Angle between ``a`` and ``b`` of each camera in degrees, float64 [N]."""
    vectors = _turn_vectors(a.rotations, b.rotations)
    return np.asarray(np.degrees(np.linalg.norm(vectors, axis=1)))


def shifts(a: Poses, b: Poses) -> Float64[np.ndarray, " N"]:
    """Distance between ``a`` and ``b`` of each camera in scene units, float64 [N]."""
    return np.asarray(np.linalg.norm(a.centers - b.centers, axis=1))


def spread(poses: Poses) -> float:
    """Root mean square distance of the cameras from their middle, in scene units."""
    return float(np.sqrt(np.square(poses.centers - poses.centers.mean(axis=0)).sum(axis=1).mean()))


def align(moved: Poses, given: Poses) -> Poses:
    """``moved`` in the world frame of ``given``, by one rotation, scale and translation.

    Rotations count as well as centres: cameras along a line say nothing of the roll about it.
    Each is weighed by its noise, which is estimated from the residuals, and a camera far from its
    given pose counts little.

    Args:
        moved: Poses in a frame of their own.
        given: The same cameras' poses in the wanted frame, not all in one place.

    Returns:
        The poses of ``moved``, with ``given``'s scale and orientation.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  (slow to import)

    size = spread(given)

    def residuals(x: Float64[np.ndarray, " 7"], noise: tuple[float, float]) -> Any:
        new = _moved_by(x, moved, given, size)
        shift = (new.centers - given.centers) / (size * noise[0])
        return np.stack([shift, _turn_vectors(new.rotations, given.rotations) / noise[1]])

    x, noise = np.zeros(7), (0.02, 0.02)
    for _ in range(_ROUNDS):
        x = least_squares(lambda x: residuals(x, noise).ravel(), x, loss="soft_l1").x  # noqa: B023
        lengths = np.median(np.linalg.norm(residuals(x, (1.0, 1.0)), axis=2), axis=1) / _TYPICAL
        noise = (max(float(lengths[0]), _LEAST_NOISE), max(float(lengths[1]), _LEAST_NOISE))
    return _moved_by(x, moved, given, size)


def _moved_by(x: Float64[np.ndarray, " 7"], moved: Poses, given: Poses, size: float) -> Poses:
    """``moved`` after the similarity ``x``: a turn, a shift and the logarithm of a scale.

    At zero it brings the mean rotation and the middle of the cameras to ``given``'s.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    mean = Rotation.from_matrix(given.rotations.transpose(0, 2, 1) @ moved.rotations).mean()
    new_from_old = (Rotation.from_rotvec(x[:3]) * mean).as_matrix()
    centered = (moved.centers - moved.centers.mean(axis=0)) @ new_from_old.T
    middle = given.centers.mean(axis=0) + x[3:6] * size
    return Poses(moved.rotations @ new_from_old.T, np.exp(x[6]) * centered + middle)


def _turn_vectors(
    a: Float64[np.ndarray, "N 3 3"], b: Float64[np.ndarray, "N 3 3"]
) -> Float64[np.ndarray, "N 3"]:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    return np.asarray(Rotation.from_matrix(a @ b.transpose(0, 2, 1)).as_rotvec())
