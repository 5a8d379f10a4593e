"""The scale (and shift) that takes an image's depth map to scene units, from its SfM points.

Notation: at an SfM point that falls into a pixel, ``value`` is the map's and ``z`` the point's
planar depth. For maps of the kinds "z" and "ray" z = scale value (value divided by the length of
the pixel's ray for "ray"; the shift is 0), for "inverse" 1 / z = scale value + shift. Promise: an
image is left out when too few of its points see depth, or when it fits much worse than the others;
each such image is reported with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.depth.fits import (
    least_squares_line,
    least_squares_scale,
    median,
    median_scale,
    robust_line,
)
from splatseed.depth.planar import map_camera, ray_length
from splatseed.depthmap import DepthKind, DepthMap
from splatseed.errors import SceneNotFoundError
from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Scene
from splatseed.views.visibility import SeenPoints, camera_points, find_visibility

Fit = Literal["robust", "least-squares"]
"""Medians and reweighting, or the paper's equation 7."""

GOOD_RESIDUAL = 0.01
"""An image that fits this well is never an outlier, however well the others fit."""

MAX_RESIDUAL = 0.25
"""An image whose median error exceeds this is not aligned at all."""


UNIT_POINTS = 20
UNIT_SLACK = 1.25
"""A map in scene units is refused if at least this many SfM points show it off by this factor."""


@dataclass(frozen=True)
class Alignment:
    """How an image's depth map is taken to scene units.

    Args:
        scale: Scene units per unit of the map; for inverse depth, inverse scene units per unit.
        shift: Added after scaling; 0 except for inverse depth.
        num_points: SfM points that see depth.
        residual: Median of the points' |aligned depth / depth of the point - 1|; NaN without
            points.
        rejected: Why the image is left out, in one sentence; None = it is used.
    """

    scale: float
    shift: float
    num_points: int
    residual: float
    rejected: str | None = None


def align(
    scene: Scene,
    *,
    fit: Fit = "robust",
    min_points: int = 20,
    max_residual_ratio: float | None = 3.0,
    progress: Progress = silent,
) -> dict[str, Alignment]:
    """Align every depth map of a scene.

    Args:
        scene: A scene with ``depths``, images and SfM points.
        fit: "robust": the median of z / value, or a line by reweighted least squares for inverse
            depth. "least-squares": the paper's equation 7.
        min_points: Images with fewer points that see depth are rejected.
        max_residual_ratio: Images whose residual exceeds this many times the median image's, and
            1%, are rejected; None keeps all.
        progress: Called with the stage and the fraction done.

    Returns:
        The alignments of all images that have a map, by name, in the order of ``scene.images``;
        rejected images are included.

    Raises:
        SceneNotFoundError: The scene has no maps, or a map's file is gone.
        SceneFormatError: A map cannot be read, or differs from its image in aspect ratio.
    """
    if scene.depths is None:
        raise SceneNotFoundError(
            "a scene with depth maps", found="none", fix="Name their folder with --depth."
        )
    depths, visibility = scene.depths, find_visibility(scene)
    images = [image for image in scene.images if image.name in depths]
    alignments: list[Alignment | None] = [None] * len(images)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            depth = depths.read(images[i].name)
            camera = map_camera(depth, images[i])
            points = camera_points(camera, visibility.of(images[i]))
            alignments[i] = align_map(depth, camera, points, fit, min_points)

    in_threads(work, len(images), 1, "align depth", progress)
    aligned = {
        image.name: alignment
        for image, alignment in zip(images, alignments, strict=True)
        if alignment is not None
    }
    return reject_outliers(aligned, max_residual_ratio)


def align_map(
    depth: DepthMap, camera: Camera, points: SeenPoints, fit: Fit, min_points: int
) -> Alignment:
    """Align one map with the SfM points that its image sees.

    Args:
        depth: The map.
        camera: The image's camera in pixels of the map (``DepthMap.camera``).
        points: The points that the image sees, in pixels of the map.
        fit: As in ``align``.
        min_points: As in ``align``.
    """
    value, z = values_at(depth, camera, points)
    if len(value) < max(min_points, 1):
        return Alignment(np.nan, 0.0, len(value), np.nan, _too_few(depth, len(value), min_points))
    if np.ptp(depth.values[np.isfinite(depth.values)]) == 0:
        told = "the map has one value everywhere: its estimation failed on this image"
        return Alignment(np.nan, 0.0, len(value), np.nan, told)
    scale, shift = _fit(depth.kind, value, z, fit)
    residual = _residual(depth.kind, value, z, scale, shift)
    return Alignment(scale, shift, len(value), residual, _misfit(depth.kind, scale, residual))


def trust_units(depth: DepthMap, camera: Camera, points: SeenPoints) -> Alignment:
    """Take a map as being in scene units, and check it against the SfM points if there are any.

    Args:
        depth: The map.
        camera: The image's camera in pixels of the map.
        points: The points that the image sees, in pixels of the map.
    """
    value, z = values_at(depth, camera, points)
    plain = Alignment(1.0, 0.0, len(value), np.nan)
    if not np.isfinite(depth.values).any():
        return replace(plain, rejected=_too_few(depth, 0, 0))
    if len(value) < UNIT_POINTS:
        return plain
    plain = replace(plain, residual=_residual(depth.kind, value, z, 1.0, 0.0))
    with np.errstate(divide="ignore"):
        ratio = float(np.median((1.0 / value if depth.kind == "inverse" else value) / z))
    # Depth in millimetres, or of another scene, is off by far more.
    if 1.0 / UNIT_SLACK < ratio < UNIT_SLACK:
        return plain
    return replace(plain, rejected=f"its depth is {ratio:.3g} times that of the SfM points")


def values_at(
    depth: DepthMap, camera: Camera, points: SeenPoints
) -> tuple[Float64[np.ndarray, " K"], Float64[np.ndarray, " K"]]:
    """The map's values at the points, and the points' planar depths: [K] each, K <= M see depth.

    A point takes the value of the pixel it falls into. Distances along the ray are turned into
    planar depth by the ray through that pixel's centre.
    """
    column, row = points.uv.astype(np.int64).T
    value = depth.values[row, column].astype(np.float64)
    if depth.kind == "ray":
        value /= ray_length(camera, column, row)
    known = np.isfinite(value) & ((value > 0) | (depth.kind == "inverse"))
    return value[known], points.z[known]


def reject_outliers(
    alignments: dict[str, Alignment], max_ratio: float | None
) -> dict[str, Alignment]:
    """Reject the images that fit much worse than the median of those not yet rejected."""
    residuals = [a.residual for a in alignments.values() if a.rejected is None]
    if max_ratio is None or not residuals:
        return alignments
    typical = float(np.median(residuals))
    # The median image is not an outlier; 1% is good whatever the others do.
    limit = max(max_ratio * typical, GOOD_RESIDUAL)
    return {
        name: replace(a, rejected=f"depth is off by {a.residual:.1%}, typically {typical:.1%}")
        if a.rejected is None and a.residual > limit
        else a
        for name, a in alignments.items()
    }


def _fit(
    kind: DepthKind, value: Float64[np.ndarray, " M"], z: Float64[np.ndarray, " M"], fit: Fit
) -> tuple[float, float]:
    """Scale and shift for the kind of map."""
    if kind == "inverse":
        return (robust_line if fit == "robust" else least_squares_line)(value, z)
    return (median_scale if fit == "robust" else least_squares_scale)(value, z), 0.0


def _residual(
    kind: DepthKind,
    value: Float64[np.ndarray, " M"],
    z: Float64[np.ndarray, " M"],
    scale: float,
    shift: float,
) -> float:
    """Median relative error of depth.

    A point that would lie behind the camera has an infinite error.
    """
    aligned = scale * value + shift
    if kind == "inverse":
        # Where 1 / z would not be positive there is no depth.
        aligned = 1.0 / np.where(aligned > 0, aligned, np.nan)
    error = np.abs(aligned / z - 1.0)
    return float(median(np.where(np.isfinite(error), error, np.inf)))


def _too_few(depth: DepthMap, num: int, min_points: int) -> str:
    if not np.isfinite(depth.values).any():
        return "the map has no depth at any pixel"
    return f"{num} SfM points see depth; {max(min_points, 1)} are needed"


def _misfit(kind: DepthKind, scale: float, residual: float) -> str | None:
    """Why a fit is not valid: the wrong kind of map, or a map of another scene."""
    if kind == "inverse" and not scale > 0:
        return "values rise with depth, so they are not its inverse"
    if not residual <= MAX_RESIDUAL:
        return f"depth is off by {residual:.0%} at half of the SfM points"
    return None
