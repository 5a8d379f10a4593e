"""Lens distortion that photographs have and cameras lack, or the reverse, by the points.

``intrinsics_error`` measures it. It is named if, once it is undone, none is left, photographs
confirm no fewer points, and show those far from the centre nearer to where they should be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.checkup.consistency import Evidence, Fit
from splatseed.checkup.focal_lengths import describe_group
from splatseed.checkup.intrinsics_error import IntrinsicsError, estimate_intrinsics_error
from splatseed.findings import Finding
from splatseed.lens import undistort_command
from splatseed.scene import Image, Scene

WRONG_DISTORTION = "wrong-distortion"


@dataclass(frozen=True)
class _Settings:
    """When distortion is named."""

    min_motion: float = 0.006
    """Motion of a photograph's corners, in longer sides."""
    min_deviations: float = 6.0
    """Standard deviations of the coefficient."""
    max_miss: float = 0.8
    """Miss that may be left, as a share of that before."""
    min_support: float = 0.2
    """Support of points once distortion is undone."""
    kept_support: float = 0.9
    """Share of the support that is kept: other points lie within the photographs then."""
    rounds: int = 3
    converged: float = 0.1
    """Estimates of a coefficient, each with the one before undone, until it changes by less."""


DISTORTED = _Settings()
_RADIAL = {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}
"""Models whose first coefficient is that of r^2."""


@dataclass(frozen=True, eq=False)
class FoundDistortion:
    """Cameras that fit the photographs better than the given ones."""

    radial: Float64[np.ndarray, " C"] | None
    """k1 of each group of cameras, beyond what the record has; None: records without theirs."""
    fit: Fit
    plain: tuple[Fit, Fit]  # before and after, of points chosen without regard to their colours
    before: float  # px that such points miss their places by, far from the centre
    after: float  # with these cameras


def find_distortion(evidence: Evidence, fit: Fit, groups: Sequence[int]) -> FoundDistortion | None:
    """Find lens distortion with which points fit photographs better; None if there is none.

    ``groups`` says for each image, from 0, whose cameras' distortion is one.
    """
    given = [image.intrinsics for image in evidence.images]
    before = estimate_intrinsics_error(evidence, fit, evidence.given, groups)
    clear = _clear(evidence.images, groups, before)
    distorted = any(lens.has_distortion for lens in given)
    if not clear.any() and not (distorted and fit.support < DISTORTED.min_support):
        return None
    # Far from the centre, where distortion moves points most, their colours do not fit.
    plain = evidence.fit(evidence.given, by_color=False)
    before = estimate_intrinsics_error(evidence, plain, evidence.given, groups)
    if distorted:
        lenses = [lens.pinhole for lens in given]
        found, after = _with_lenses(evidence, lenses, groups, plain, before)
        if _fits(found) and not _clear(evidence.images, groups, after).any():
            return found
    if not clear.any() or not all(lens.is_pinhole or lens.model in _RADIAL for lens in given):
        return None
    radial, change = np.zeros(len(clear)), before.radial
    for _ in range(DISTORTED.rounds):
        radial = radial + np.where(clear, change, 0.0)
        lenses = [_with_radial(lens, radial[g]) for lens, g in zip(given, groups, strict=True)]
        found, after = _with_lenses(evidence, lenses, groups, plain, before)
        change = after.radial
        if np.all(np.abs(change[clear]) <= DISTORTED.converged * np.abs(radial[clear])):
            break
    if _clear(evidence.images, groups, after).any():
        return None
    return replace(found, radial=radial) if _fits(found) else None


def _clear(
    images: Sequence[Image], groups: Sequence[int], error: IntrinsicsError
) -> Bool[np.ndarray, " C"]:
    """Whether the distortion of each group clearly moves the corners of its photographs."""
    motion = np.zeros(len(error.radial))
    for group, k in enumerate(error.radial):
        lens = images[list(groups).index(group)].lens
        radius = np.hypot(lens.width / lens.K[0, 0], lens.height / lens.K[1, 1]) / 2
        motion[group] = abs(k) * radius**3 * lens.K[0, 0] / max(lens.width, lens.height)
    enough = np.abs(error.radial) >= DISTORTED.min_deviations * error.radial_sigma
    return np.asarray(enough & (motion >= DISTORTED.min_motion))


def _with_radial(lens: Intrinsics, k: float) -> Intrinsics:
    """The camera with k added to its coefficient of r^2."""
    if lens.is_pinhole:
        fx, fy, cx, cy = lens.pinhole.params
        return replace(lens, model="OPENCV", params=(fx, fy, cx, cy, k, 0.0, 0.0, 0.0))
    first = CAMERA_MODELS[lens.model].num_focal + 2
    params = (*lens.params[:first], lens.params[first] + k, *lens.params[first + 1 :])
    return replace(lens, params=params)


def _with_lenses(
    evidence: Evidence,
    lenses: Sequence[Intrinsics],
    groups: Sequence[int],
    plain: Fit,
    before: IntrinsicsError,
) -> tuple[FoundDistortion, IntrinsicsError]:
    """Measure the capture with other cameras."""
    pairs = zip(evidence.images, lenses, strict=True)
    images = [replace(image, intrinsics=lens) for image, lens in pairs]
    other = Evidence(evidence.scene, images)
    without = other.fit(other.given, by_color=False)
    after = estimate_intrinsics_error(other, without, other.given, groups)
    fit = other.fit(other.given)
    return FoundDistortion(None, fit, (plain, without), before.miss, after.miss), after


def _fits(found: FoundDistortion) -> bool:
    before, after = (fit.support for fit in found.plain)
    nearer = found.after <= DISTORTED.max_miss * found.before or np.isnan(found.before)
    kept = after >= DISTORTED.kept_support * before
    return bool(found.fit.support >= DISTORTED.min_support and kept and nearer)


def distortion_finding(
    scene: Scene, images: Sequence[Image], groups: Sequence[int], found: FoundDistortion
) -> Finding:
    """Name distortion, with the numbers before and after, and say what mends it."""
    shares = "{:.0%} of the points, and {:.0%}".format(*(fit.confirmed for fit in found.plain))
    misses = f"those far from the centre are off by {found.before:.2g} px, and {found.after:.2g} px"
    if found.radial is None:
        text = (
            "The photographs do not have the lens distortion of their cameras: they confirm "
            f"{shares} without it; {misses} without it."
        )
        fix = (
            "Give the cameras no distortion (PINHOLE), or use the photographs before undistortion."
        )
        return Finding(WRONG_DISTORTION, text, "error", fix=fix)
    k = " and ".join(
        f"k1 = {each:.2g}{describe_group(images, groups, group)}"
        for group, each in enumerate(found.radial.tolist())
        if each
    )
    more = " beyond these" if any(image.intrinsics.has_distortion for image in images) else ""
    text = (
        f"The photographs have lens distortion that their cameras lack, about {k}{more}: they "
        f"confirm {shares} once it is removed; {misses} after that."
    )
    undistort = f": {undistort_command(scene.source.root)}" if scene.source.root else ""
    fix = (
        "Use the undistorted photographs that belong to these cameras, or give the cameras this "
        f"distortion (SIMPLE_RADIAL) and undistort{undistort}."
    )
    return Finding(WRONG_DISTORTION, text, "error", fix=fix)
