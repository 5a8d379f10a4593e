"""Which kind and unit of depth maps in files hold, found by the SfM points that images see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatseed.depth.alignment import LIMITS, Alignment, align_map, map_camera
from splatseed.depth.settings import DepthSettings
from splatseed.depthmap import DepthKind
from splatseed.findings import Finding
from splatseed.io.depth_files import KINDS
from splatseed.io.depth_maps import DEPTH_KIND, DepthFiles
from splatseed.photos.visibility import Visibility, points_in_image
from splatseed.sampling import evenly_spaced
from splatseed.scene import Image, Scene

_MAPS = 6
"""Maps that are compared with the points."""
_CLEARLY = 2 / 3
"""Share of the stated kind's residual below which another kind fits clearly better."""
_AGREEING = 0.75
"""Share of the maps that another kind must fit clearly better."""
_SAME_UNIT = 1.05
"""Ratio of the maps' factors that are one unit."""
UNIT_MISMATCH = "depth-unit-mismatch"
"""Kind of the finding that depth maps have another unit than the poses."""
_NAMES: dict[DepthKind, str] = {
    "z": "planar depth (z)",
    "ray": "distance along the ray (ray)",
    "inverse": "inverse depth (inverse)",
}


def with_fitting_kind(scene: Scene, visibility: Visibility) -> tuple[Scene, list[Finding]]:
    """Read a scene's depth maps as the kind that fits its points, unless their kind is stated.

    Returns:
        The scene, and a finding where another kind than the stated or assumed one fits clearly
        better.

    Raises:
        SceneNotFoundError: A map's file is gone.
        SceneFormatError: A map cannot be read, or differs from its image in aspect ratio.
    """
    maps = scene.depths
    if not isinstance(maps, DepthFiles) or not len(maps):
        return scene, []
    images = [image for image in scene.images if image.name in maps]
    images = [images[i] for i in evenly_spaced(len(images), _MAPS)]
    stated = maps.read(images[0].name).kind
    residuals = {kind: _residuals(maps, kind, images, visibility) for kind in KINDS}
    known = np.isfinite(list(residuals.values())).any(axis=0)
    if not known.any():
        return scene, []
    limits = np.maximum(residuals[stated][known] * _CLEARLY, LIMITS.good_residual)
    better = {kind: np.mean(each[known] < limits) for kind, each in residuals.items()}
    typical = {kind: float(np.median(each[known])) for kind, each in residuals.items()}
    kind = min(KINDS, key=lambda each: typical[each])
    if kind == stated or better[kind] < _AGREEING or typical[stated] < LIMITS.good_residual:
        return scene, _unit_finding(maps, images, visibility)
    off, wrong = (f"{100 * min(typical[each], 9.9):.2g}%" for each in (kind, stated))
    points = f"the SfM points to within {off} at the median"
    if maps.kind is not None:
        text = (
            f"The depth maps fit {points} as {_NAMES[kind]}; as {_NAMES[stated]}, which is stated, "
            f"they are off by {wrong}."
        )
        fix = f"Pass `depth_kind={kind!r}`, or correct the statement."
        return scene, [Finding(DEPTH_KIND, text, "warning", fix=fix)]
    text = (
        f"The depth maps are read as {_NAMES[kind]}, which fits {points}: as {_NAMES[stated]} they "
        f"are off by {wrong}."
    )
    return scene.replace(depths=_read_as(maps, kind)), [Finding(DEPTH_KIND, text, "info")]


def _unit_finding(maps: DepthFiles, images: list[Image], visibility: Visibility) -> list[Finding]:
    """Name the unit of maps that claim the scene's, and that alignment multiplies by one factor."""
    found = [_aligned(maps, image, visibility) for image in images if maps.in_scene_units]
    scales = [each.scale for each in found if each.rejected is None and not each.shift]
    factor = float(np.median(scales)) if scales else 1.0
    right = 1 / LIMITS.unit_factor < factor < LIMITS.unit_factor
    if right or max(scales) > _SAME_UNIT * min(scales):
        return []
    text = (
        f"The depth maps have another unit than the scene: they are multiplied by {factor:.4g}, "
        "with which they fit its points."
    )
    return [Finding(UNIT_MISMATCH, text, "info")]


def _aligned(maps: DepthFiles, image: Image, visibility: Visibility) -> Alignment:
    depth = maps.read(image.name).reliable(DepthSettings.min_confidence)
    camera = map_camera(depth, image)
    return align_map(depth, camera, points_in_image(camera, visibility.of(image)))


def _read_as(maps: DepthFiles, kind: DepthKind) -> DepthFiles:
    return replace(maps, kind=kind, lines=maps.lines if kind == "inverse" else {})


def _residuals(
    maps: DepthFiles, kind: DepthKind, images: list[Image], visibility: Visibility
) -> np.ndarray:
    """Return each map's residual as depth of this kind, float64 [V]; infinite where it cannot be.

    NaN where there are too few points.
    """
    maps, residuals = _read_as(maps, kind), np.full(len(images), np.nan)
    for i, image in enumerate(images):
        found = _aligned(maps, image, visibility)
        if found.num_points >= DepthSettings.min_points:
            rising = kind == "inverse" and not found.scale > 0
            residuals[i] = np.inf if rising or np.isnan(found.residual) else found.residual
    return residuals
