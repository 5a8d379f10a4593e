"""Focal lengths of another image size, by photographs alone: for captures without points.

With wrong focal lengths points miss their epipolar lines (``pose_accuracy``), unless cameras only
move sideways. Where poses are inexact, the factor of all focal lengths with the smallest error is
searched for, and named if that error is a fraction of the given one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatseed.checkup.focal_lengths import WRONG_FOCAL_LENGTH
from splatseed.checkup.hypotheses import centering_factor, peak
from splatseed.checkup.pose_accuracy import MAX_EXACT, PoseErrorEstimate, estimate_focal_errors
from splatseed.findings import Finding
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene


@dataclass(frozen=True)
class _Settings:
    """Which factors are tried, and when one is named."""

    factors: tuple[float, ...] = tuple(np.geomspace(0.35, 2.85, 11).tolist())
    fine_steps: tuple[float, ...] = (0.86, 0.93, 1.07, 1.15)
    min_degrees: float = 0.1
    """Error of poses from which on factors are tried; a phone's poses have 0.08."""
    max_error: float = 0.5
    """Error that may be left, as a share of that before."""
    min_change: float = 0.05
    """Difference of the factor from 1."""
    max_px: float = 2 * MAX_EXACT
    """Error that may be left, in pixels."""


SEARCH = _Settings()


def find_focal_length(
    scene: Scene,
    images: Sequence[Image],
    error: PoseErrorEstimate | None,
    progress: Progress = silent,
) -> tuple[Finding, ...]:
    """Name the factor of all focal lengths with which photographs fit; nothing if there is none.

    ``error`` is that of the poses as they are: if it is small, nothing is tried. None: too few
    places were found again, as with focal lengths that are far off.
    """
    if error is not None and (error.exact or error.degrees < SEARCH.min_degrees):
        return ()
    tried = [(factor, 1.0) for factor in (1.0, *SEARCH.factors)]
    if (center := centering_factor(images)) is not None:
        tried.append((center, center))
    errors = estimate_focal_errors(scene, images, tried, progress)
    if not errors:
        return ()
    best = min(errors, key=lambda factors: errors[factors])
    focal, center = best
    if center == 1.0:  # else the factor is exact
        near = [(focal * step, 1.0) for step in SEARCH.fine_steps]
        errors |= estimate_focal_errors(scene, images, near, silent)
        known = [factors for factors in (best, *near) if factors in errors]
        focal = peak([f for f, _ in known], [-(errors[factors] ** 2) for factors in known])
        best = (focal, 1.0)
        errors |= estimate_focal_errors(scene, images, [best], silent)
    # Not ``error``, which may be that of other pairs.
    before, after = errors.get((1.0, 1.0)), errors.get(best, np.inf)
    limit = SEARCH.max_px if before is None else SEARCH.max_error * before
    if after > min(limit, SEARCH.max_px) or abs(focal - 1) < SEARCH.min_change:
        return ()
    missed = "at too few places to measure" if before is None else f"by about {before:.2g} px"
    given = images[0].intrinsics
    what = "focal lengths" if center == 1.0 else "focal lengths and principal points"
    text = (
        f"The {what} are not those of the photographs: photographs miss each other {missed}, and "
        f"by {after:.2g} px with {what} {focal:.3g} times as large."
    )
    others = "" if len({image.intrinsics.camera_id for image in images}) == 1 else " of the first"
    size = f"{given.width} x {given.height} pixels"
    fix = f"Set the focal length{others} to about {focal * given.K[0, 0]:.4g} px, for {size}"
    if center != 1.0:
        fix += f", the principal point to {given.K[0, 2] * center:.5g}, "
        fix += f"{given.K[1, 2] * center:.5g}"
    return (Finding(WRONG_FOCAL_LENGTH, text, "error", fix=f"{fix}."),)
