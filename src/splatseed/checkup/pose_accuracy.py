"""How exact the poses of photographs are, measured without points, in a few seconds.

Errors of pose move points off their epipolar lines. Corners of view i are searched for in view j,
which is first rotated into i's orientation, so that a point at inverse depth w moves from pixel p
to ``K (K^-1 p + w c)``, c the translation: a straight line. A corner's *miss* is the distance from
this line at which it is found, in pixels, where one place correlates clearly best. The median over
a pair's corners, and then over the pairs, is the error. Masked pixels are no corners. Wrong focal
lengths move points off their lines, too, unless cameras only move sideways: of several factors, the
right one has by far the smallest error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import gaussian_filter, maximum_filter, sobel

from splatseed.checkup._kernels import correlate_patch, interpolate
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.findings import Finding
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.projection import pixel_centers
from splatseed.sampling import evenly_spaced
from splatseed.scene import Image, Scene

Gray = Float64[np.ndarray, "H W"]
Pixel = Float64[np.ndarray, " 2"]

INEXACT_POSES = "inexact-poses"
"""Kind of the finding that poses may be refined."""
MAX_EXACT = 0.5
"""Maximum error of exact poses, in pixels at the size of stereo. COLMAP's are 0.1 to 0.5 on eight
captures; at 0.55, a tenth of a degree of noise, fern keeps 0.6 of its depths
(benchmarks/stereo)."""


@dataclass(frozen=True)
class _Settings:
    """How corners are found and matched; pixels are those of the reduced photographs."""

    side: int = 400
    """Maximum longer side of the photographs, in pixels."""
    photographs: int = 5
    partners: int = 2
    """Views that each photograph is compared with."""
    corners: int = 100
    """Maximum number per photograph."""
    corner_spacing: int = 9
    half_patch: int = 5
    """A patch is ``2 half_patch + 1`` pixels wide."""
    max_miss: int = 24
    max_motion: float = 0.3
    """Maximum motion along the line, in widths of a photograph."""
    min_correlation: float = 0.85
    min_lead: float = 0.1
    """Minimum correlation above that of any other place."""
    min_found: int = 8
    """Corners of a pair that must be found for it to count."""
    min_pairs: float = 1 / 3
    """Fraction of pairs that must count; at sound poses of eight captures 0.6 and more do."""
    max_median: float = 10.0
    """A larger median error may be chance: wrong matches are spread over ``max_miss``."""


POSE_ACCURACY = _Settings()
_HALF, _REACH = POSE_ACCURACY.half_patch, POSE_ACCURACY.max_miss


@dataclass(frozen=True)
class PoseErrorEstimate:
    """By how much points miss their epipolar lines."""

    px: float  # median over pairs, in pixels at the size at which stereo compares photographs
    degrees: float  # the rotation of a camera that moves its image as far
    exact: bool  # at most ``MAX_EXACT`` pixels
    side: int  # longer side of that size

    def __str__(self) -> str:
        return f"{self.px:.2g} px ({self.degrees:.2g} degrees) at {self.side:,} px a side"

    @property
    def verdict(self) -> str:
        """The error, and whether the poses are exact."""
        return f"{self}: {'exact, at most' if self.exact else 'above'} {MAX_EXACT:g} px"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """A warning with advice; nothing if the poses are exact."""
        if self.exact:
            return ()
        text = (
            f"The photographs are misaligned by about {self}, the size at which stereo compares "
            f"them; above {MAX_EXACT:g} px, `refine_poses=True` may help."
        )
        return (Finding(INEXACT_POSES, text),)


def estimate_pose_error(
    scene: Scene, images: Sequence[Image], progress: Progress = silent
) -> PoseErrorEstimate | None:
    """Estimate the error of the poses of two or more photographs.

    Returns None if too few corners are found again, as on plain walls or with poses that are far
    off.
    """
    return _of_pairs(images, _load_pairs(scene, images, progress))


def estimate_focal_errors(
    scene: Scene,
    images: Sequence[Image],
    factors: Sequence[tuple[float, float]],
    progress: Progress = silent,
) -> dict[tuple[float, float], float]:
    """Return the error in pixels with focal lengths and principal points multiplied by factors.

    Those with which too few corners are found again are left out.
    """
    pairs = list(_load_pairs(scene, images, silent))
    errors: dict[tuple[float, float], float] = {}
    for number, factor in enumerate(factors):
        error = _of_pairs(images, [[_zoomed(view, *factor) for view in pair] for pair in pairs])
        errors |= {} if error is None else {factor: error.px}
        progress("try focal lengths", (number + 1) / len(factors))
    return errors


def _zoomed(view: View, focal: float, center: float) -> View:
    K = view.K.copy()
    K[:2, :2] *= focal
    K[:2, 2] *= center
    return replace(view, camera=replace(view.camera, K=K))


def _load_pairs(
    scene: Scene, images: Sequence[Image], progress: Progress
) -> Iterator[Sequence[View]]:
    """Load a few views, each with its partners, one after the other."""
    poses = np.array([image.camera.cam_from_world for image in images])
    partners = choose_by_pose(poses, POSE_ACCURACY.partners)
    factor = factor_for_size(images, POSE_ACCURACY.side)
    chosen = evenly_spaced(len(images), POSE_ACCURACY.photographs).tolist()
    for number, i in enumerate(chosen):
        compared = [images[i], *(images[j] for j in partners[i].tolist() if j >= 0)]
        yield load_views(scene, compared, data_factor=factor, undistort=True, draft=True)
        progress("measure poses", (number + 1) / len(chosen))


def _of_pairs(
    images: Sequence[Image], compared: Iterable[Sequence[View]]
) -> PoseErrorEstimate | None:
    """Estimate the error of views, each with its partners."""
    errors, pairs = [], 0
    for view, *others in compared:
        pairs += len(others)
        for other in others:
            misses = np.abs(_misses(view, other))
            if len(misses) >= POSE_ACCURACY.min_found:
                px = float(np.median(misses))
                errors.append((px, np.degrees(np.arctan(px / view.K[0, 0]))))
    if len(errors) < max(1.0, POSE_ACCURACY.min_pairs * pairs):
        return None
    px, degrees = np.median(errors, axis=0).tolist()
    if px > POSE_ACCURACY.max_median:
        return None
    factor = factor_for_size(images, POSE_ACCURACY.side)
    stereo_factor = factor_for_size(images, StereoSettings.max_size)
    px *= factor / stereo_factor
    side = max(max(image.camera.width, image.camera.height) for image in images)
    return PoseErrorEstimate(px, degrees, round(px, 2) <= MAX_EXACT, side // stereo_factor)


def given_pose_error(
    scene: Scene, images: Sequence[Image], progress: Progress = silent
) -> PoseErrorEstimate | None:
    """Estimate the error of poses of which no points are known, by the training views.

    Drift shows between neighbours that are further apart: of a phone's walk (``corridor``), whose
    refined poses gain 2.3 dB, all views have 0.50 px, which is exact, and those to train 0.74.
    Without an estimate, as poses that are far off leave too few corners there, all are measured.
    """
    names = {image.name for image in scene.split(scene.default_test_every)[0]}
    train = [image for image in images if image.name in names]
    error = estimate_pose_error(scene, train, progress) if len(train) > 1 else None
    return error or estimate_pose_error(scene, images, progress)


def _misses(view: View, other: View) -> Float64[np.ndarray, " M"]:
    """Return the signed distances from their epipolar lines at which corners are found."""
    j_from_i = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    max_motion = POSE_ACCURACY.max_motion * view.width
    margin = int(max_motion) + _REACH + 2 * _HALF
    image = _gray(view)
    homography = other.K @ j_from_i[:3, :3] @ np.linalg.inv(view.K)
    rotated = _rotated(_gray(other), homography, view, margin)
    # c: the translation in i's axes, as R d + w t = R (d + w R' t).
    step = view.K @ (j_from_i[:3, :3].T @ j_from_i[:3, 3])
    misses = []
    for p in _corners(image, view.surface):
        # d/dw of K (K^-1 p + w c) at w = 0, where a far point starts to move.
        along = step[:2] - step[2] * p
        length = np.linalg.norm(along)
        if length >= 1e-9 * max(1.0, abs(step[2])):
            miss = _miss(image, rotated, p, along / length, margin, max_motion)
            misses += [] if miss is None else [miss]
    return np.array(misses)


def _gray(view: View) -> Gray:
    return np.asarray(view.photograph.mean(axis=2))


def _rotated(image: Gray, homography: Float64[np.ndarray, "3 3"], view: View, margin: int) -> Gray:
    """Resample a photograph in the view's orientation, with a margin; NaN outside of it."""
    rows, columns = view.height + 2 * margin, view.width + 2 * margin
    uv = pixel_centers(rows, columns) - margin
    rays = np.concatenate([uv, np.ones((rows, columns, 1))], axis=-1) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    turned: Gray = interpolate(image, *np.where(rays[..., 2] <= 0, -1.0, [x - 0.5, y - 0.5]))
    return turned


def _corners(image: Gray, mask: Bool[np.ndarray, "H W"] | None) -> Float64[np.ndarray, "N 2"]:
    """Return the strongest Shi-Tomasi corners (column, row), strongest first.

    Masked ones are left out: a turntable's background does not turn with it.
    """
    x, y = sobel(image, axis=1), sobel(image, axis=0)
    xx, xy, yy = (gaussian_filter(product, 2.0) for product in (x * x, x * y, y * y))
    # The smaller eigenvalue of the structure tensor.
    strength = 0.5 * (xx + yy - np.hypot(xx - yy, 2 * xy))
    peaks = (strength == maximum_filter(strength, POSE_ACCURACY.corner_spacing)) & (strength > 0)
    if mask is not None:
        peaks &= mask
    row, column = np.nonzero(peaks)
    best = np.argsort(-strength[peaks], kind="stable")[: POSE_ACCURACY.corners]
    return np.stack([column[best], row[best]], axis=1) + 0.5


def _miss(
    image: Gray, rotated: Gray, p: Pixel, along: Pixel, margin: int, max_motion: float
) -> float | None:
    """Return a corner's signed distance from its line; None unless one place is clearly best."""
    patch = _sample(image, p, along, (-_HALF, _HALF), _HALF)
    if not np.isfinite(patch).all():  # beyond the image border
        return None
    # Slightly backwards, too: with wrong poses a far point may seem to be behind infinity.
    length = -_HALF - _REACH, _HALF + int(max_motion)
    scores = correlate_patch(patch, _sample(rotated, p + margin, along, length, _HALF + _REACH))
    at = np.unravel_index(np.argmax(scores), scores.shape)
    best, (column, row) = scores[at], at
    rest = scores.copy()
    columns = slice(max(column - _HALF, 0), column + _HALF + 1)
    rest[columns, max(row - _HALF, 0) : row + _HALF + 1] = -1.0
    inside = 0 < row < scores.shape[1] - 1
    unclear = best < POSE_ACCURACY.min_correlation or best - rest.max() < POSE_ACCURACY.min_lead
    if unclear or not inside:
        return None
    before, after = scores[column, row - 1], scores[column, row + 1]
    # The peak of a parabola through three correlations.
    bend = 2 * best - before - after
    return float(row - _REACH + (0.5 * (after - before) / bend if bend > 0 else 0.0))


def _sample(image: Gray, p: Pixel, along: Pixel, length: tuple[int, int], width: int) -> Gray:
    """Sample a band along a line through p, ``width`` pixels to both sides; NaN outside."""
    a = np.arange(length[0], length[1] + 1)[:, None]
    b = np.arange(-width, width + 1)[None]
    x = p[0] - 0.5 + a * along[0] - b * along[1]
    band: Gray = interpolate(image, x, p[1] - 0.5 + a * along[1] + b * along[0])
    return band
