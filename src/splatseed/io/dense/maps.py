"""DenseMap: what a map needs to be written, and its depth along the rays of another pixel grid.

Notation: ``K`` [3, 3] maps rays r = (x, y, 1) to pixels; a map's own pixel (column, row) has its
centre at (column + 0.5, row + 0.5). Promise: a pixel is moved along the plane given by its normal
and never mixed with its neighbours, so that no depth between two surfaces is invented.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.camera import Camera
from splatseed.errors import ParameterError
from splatseed.scene import Image

MAX_SOURCES = 8
"""``agreeing`` has one bit per source."""
_MAX_CHANGE = 1.25
"""Planes seen at so grazing an angle that depth changes by more than this factor are left out."""
_SAME_POSE = 1e-6


class DenseMap(Protocol):
    """Depth, normals and confidence of one image; ``splatseed.stereo.StereoMap`` is one."""

    @property
    def name(self) -> str:
        """The image's name."""
        ...

    @property
    def camera(self) -> Camera:
        """The camera, in pixels of this map."""
        ...

    @property
    def depth(self) -> Float32[np.ndarray, "H W"]:
        """Planar z-depth in scene units; NaN where unknown."""
        ...

    @property
    def normal(self) -> Float32[np.ndarray, "H W 3"]:
        """Unit normals in camera axes, facing the camera; NaN where unknown."""
        ...

    @property
    def confidence(self) -> Float32[np.ndarray, "H W"]:
        """Confidence, 0 to 1; 0 where depth is NaN."""
        ...

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the views that it was compared with."""
        ...

    @property
    def agreeing(self) -> UInt8[np.ndarray, "H W"]:
        """Bit k is set where source k confirms the pixel."""
        ...


def check_map(dense: DenseMap, images: Mapping[str, Image]) -> None:
    """Check that a map belongs to an image of the scene, and that its arrays match.

    Raises:
        ParameterError: One of these fails.
    """
    names = (dense.name, *dense.sources)
    if unknown := [name for name in names if name not in images]:
        _refuse(dense, "images of the scene", ", ".join(unknown[:3]))
    if len(dense.sources) > MAX_SOURCES:
        _refuse(dense, f"at most {MAX_SOURCES} sources", f"{len(dense.sources)}")
    size = (dense.camera.height, dense.camera.width)
    arrays = (dense.depth, dense.normal[..., 0], dense.confidence, dense.agreeing)
    if wrong := [each.shape for each in arrays if each.shape != size]:
        _refuse(dense, f"arrays of its camera's size, {size}", f"{wrong[0]}")
    pose = images[dense.name].camera.cam_from_world
    tolerance = _SAME_POSE * max(1.0, float(np.abs(pose).max()))
    if not np.allclose(dense.camera.cam_from_world, pose, atol=tolerance):
        _refuse(dense, "the pose of its image", "another")


def scaled_K(camera: Camera, width: int, height: int) -> Float64[np.ndarray, "3 3"]:  # noqa: N802  (K is the field's name)
    """The pinhole matrix of a camera whose image is resized to ``width`` x ``height``, [3, 3]."""
    scaled: np.ndarray = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return scaled


def depth_along(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float32[np.ndarray, "H W"]:
    """The depth of each pixel's plane along another ray nearby; NaN where unknown.

    Args:
        dense: The map.
        K: Maps the other rays to their grid, [3, 3].
        at: Pixel (column, row) gets the depth along the ray through (column + at, row + at) of that
            grid. 0.5 is a pixel's centre; COLMAP's dense stereo uses 0.
    """
    own = _toward_plane(dense, dense.camera.K, 0.5)
    other = _toward_plane(dense, K, at)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = own / other  # n . (d r) = n . (d' r'), so d' = d (n . r) / (n . r')
        near = (ratio < _MAX_CHANGE) & (ratio > 1 / _MAX_CHANGE)
    ratio = np.where(near, ratio, np.where(np.isfinite(own), np.nan, 1.0))  # no normal: unchanged
    return np.asarray(dense.depth * ratio, np.float32)


def _toward_plane(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float64[np.ndarray, "H W"]:
    """The product n . r of each pixel's normal and the ray through (column + at, row + at)."""
    height, width = dense.depth.shape
    rows, columns = np.mgrid[0:height, 0:width] + at
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    return np.asarray(np.einsum("hwc,hwc->hw", dense.normal.astype(np.float64), rays))


def _refuse(dense: DenseMap, expected: str, found: str) -> None:
    raise ParameterError(
        f"the map of {dense.name} to have {expected}",
        found=found,
        fix="Make the maps from this scene.",
    )
