"""Similarities: rotation, one scale and translation, between two frames of one scene.

Notation: ``target_from_source`` takes x to scale * rotation @ x + translation. Promise: double
precision; a fit is the least-squares one (Umeyama 1991) without reflection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from splatseed.frozen import read_only

_TOLERANCE = 1e-3
"""Largest deviation of rotation @ rotation.T from the identity."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """A map between two frames."""

    scale: float  # above 0
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]  # in the target's units

    def __post_init__(self) -> None:
        for name in ("rotation", "translation"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def points(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Map points of the source to the target."""
        turned = np.asarray(xyz, np.float64) @ self.rotation.T
        return np.asarray(self.scale * turned + self.translation)

    def camera(self, cam_from_source: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """Return ``cam_from_target`` of a camera; its depths are in the target's units."""
        cam_from_target = np.eye(4)
        rotation = cam_from_source[:3, :3] @ self.rotation.T
        cam_from_target[:3, :3] = rotation
        cam_from_target[:3, 3] = self.scale * cam_from_source[:3, 3] - rotation @ self.translation
        return cam_from_target

    @property
    def inverse(self) -> Similarity:
        """The similarity from the target to the source."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -rotation @ self.translation / self.scale)

    def then(self, second: Similarity) -> Similarity:
        """Return the composition: this similarity first, then ``second``."""
        return Similarity(
            second.scale * self.scale,
            second.rotation @ self.rotation,
            second.scale * second.rotation @ self.translation + second.translation,
        )

    @property
    def matrix(self) -> Float64[np.ndarray, "3 4"]:
        """The affine matrix [3, 4]."""
        return np.column_stack([self.scale * self.rotation, self.translation])


def similarity_of(matrix: np.ndarray) -> Similarity | None:
    """Convert an affine matrix [3, 4] or [4, 4]; None if it is no similarity."""
    if matrix.shape not in {(3, 4), (4, 4)} or not np.isfinite(matrix).all():
        return None
    linear = np.asarray(matrix[:3, :3], np.float64)
    volume = float(np.linalg.det(linear))
    if volume <= 0:
        return None
    scale = volume ** (1 / 3)
    rotation = linear / scale
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TOLERANCE:
        return None
    return Similarity(scale, rotation, np.asarray(matrix[:3, 3], np.float64))


def fit_similarity(
    source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"]
) -> Similarity | None:
    """Fit the least-squares similarity from points to their partners.

    None if there are fewer than three, or all on a line.
    """
    if len(source) < 3:
        return None
    center, goal = source.mean(axis=0), target.mean(axis=0)
    around, wanted = source - center, target - goal
    left, stretch, right = np.linalg.svd(wanted.T @ around)
    spread = float((around**2).sum())
    if spread == 0 or stretch[1] <= 1e-9 * stretch[0]:  # the rotation about the line is free
        return None
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    scale = float((stretch * signs).sum()) / spread
    return Similarity(scale, rotation, goal - scale * rotation @ center) if scale > 0 else None
