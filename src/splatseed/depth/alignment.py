"""Align depth maps to a scene's units by SfM points, and lift their pixels.

Notation: at an SfM point that falls into a pixel, ``value`` is the map's and ``z`` the point's
planar depth, float64 [M]. For maps of the kinds "z" and "ray" z = scale value (value divided by the
length of the pixel's ray for "ray"; the shift is 0), for "inverse" 1 / z = scale value + shift: the
*line* that networks of the MiDaS kind leave open. A ray has unit z in camera axes, so that its
length is distance over planar depth, and passes through its pixel's centre, at +0.5. With
``unit_ray``, as in the paper's equation 9, depth of any kind counts as distance along the ray, both
in the fit of the scale and in the lifting of pixels.
Promise: an image is rejected if too few of its points fall on known depth, or if it fits much worse
than the others; its ``Alignment`` states the reason. Nothing is random; multiplying ``z`` by a
power of two divides or multiplies the result by it exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int, Int64

from splatseed.camera import Camera
from splatseed.depth._kernels import SIGMA_OF_MEDIAN
from splatseed.depth.settings import DepthSettings, Fit
from splatseed.depthmap import DepthMap, in_scene_units
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.photos.visibility import PointsInImage, find_visibility, points_in_image
from splatseed.progress import Progress, in_threads, silent
from splatseed.projection import normalized
from splatseed.scene import Image, Scene


@dataclass(frozen=True)
class _RobustFit:
    """Robust fit of a line to SfM points."""

    num_pairs: int = 256  # pairs of points whose lines are tried
    tukey: float = 4.685  # Tukey's biweight at 95% efficiency, in standard deviations
    max_steps: int = 20  # of reweighting
    min_sigma: float = 1e-6  # relative depth: an exact fit must not divide by zero


@dataclass(frozen=True)
class _Limits:
    """Limits beyond which a map is rejected, relative to depth."""

    good_residual: float = 0.01  # never an outlier, however well other images fit
    max_residual: float = 0.25  # of the median point
    unit_points: int = 20  # SfM points needed to check a map in scene units
    unit_factor: float = 1.25  # by which such a map may be off


ROBUST, LIMITS = _RobustFit(), _Limits()
R2_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence, which fills a square evenly (Roberts, 2018); replaces random pairs."""
NO_DEPTH = "the map has no depth at any pixel"

Values = Float64[np.ndarray, " M"]


def least_squares_scale(
    raw: Float64[np.ndarray, " M ..."], sfm: Float64[np.ndarray, " M ..."]
) -> float:
    """Find the s that minimises sum |s raw - sfm|^2: the paper's equation 7.

    ``raw`` are lifted pixels before scaling, p_raw, and ``sfm`` the SfM points that project into
    them, both relative to the camera's centre.
    """
    return float(np.vdot(raw, sfm) / np.vdot(raw, raw))


def median_scale(value: Values, z: Values) -> float:
    """Median of z / value, robust to up to half of the points."""
    return float(np.median(z / value))


def least_squares_line(value: Values, z: Values) -> tuple[float, float]:
    """Find the (a, b) that minimise sum (a value + b - 1 / z)^2."""
    return _weighted_line(value, 1.0 / z, np.ones_like(z))


def robust_line(value: Values, z: Values) -> tuple[float, float]:
    """Fit (a, b) robustly, by the relative error r = z (a value + b) - 1.

    Of the lines through 256 pairs of points, the one with the smallest median error is refined by
    iteratively reweighted least squares with Tukey's biweight, as LO-RANSAC refines its best
    sample.
    """
    line = _best_of_pairs(value, 1.0 / z)
    for _ in range(ROBUST.max_steps):
        r = z * (line[0] * value + line[1]) - 1.0
        sigma = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(r))), ROBUST.min_sigma)
        # Tukey's biweight (1 - u^2)^2, 0 from 4.685 sigma on
        u = np.minimum(np.abs(r) / (ROBUST.tukey * sigma), 1.0)
        # The residual is relative, so weights on 1 / z also have the factor z squared.
        line, before = _weighted_line(value, 1.0 / z, (1.0 - u * u) ** 2 * z * z), line
        if np.allclose(line, before, rtol=1e-9, atol=0.0):
            break
    return line


def _best_of_pairs(value: Values, inverse: Values) -> tuple[float, float]:
    """Find the line through two points with the smallest median relative error."""
    order = np.argsort(value, kind="stable")
    steps = (np.arange(1, ROBUST.num_pairs + 1)[:, None] * R2_STEPS) % 1.0
    first, second = order[(steps * len(value)).astype(np.int64)].T
    run = value[first] - value[second]
    usable = run != 0
    if not usable.any():
        return 0.0, float(np.median(inverse))
    first, second, run = first[usable], second[usable], run[usable]
    # The line 1 / z = a value + b through both points.
    a = (inverse[first] - inverse[second]) / run
    b = inverse[first] - a * value[first]
    error = np.abs((a[:, None] * value + b[:, None]) / inverse - 1.0)
    best = int(np.argmin(np.median(error, axis=1)))
    return float(a[best]), float(b[best])


def _weighted_line(value: Values, target: Values, weight: Values) -> tuple[float, float]:
    """Weighted least squares of target = a value + b, about the weighted means for accuracy."""
    # a = cov(value, target) / var(value), b = mean target - a mean value
    weight = weight / weight.sum()
    mean_value, mean_target = weight @ value, weight @ target
    spread = weight @ (value - mean_value) ** 2
    if not spread > 0:
        return 0.0, float(mean_target)
    a = weight @ ((value - mean_value) * (target - mean_target)) / spread
    return float(a), float(mean_target - a * mean_value)


def map_camera(depth: DepthMap, image: Image) -> Camera:
    """Scale the camera of an image to the pixels of its map."""
    try:
        return depth.camera(image.camera)
    except SceneFormatError as error:
        expected = f"for {image.name} {error.expected}"
        raise SceneFormatError(expected, found=error.found, fix=error.fix) from None


def ray_length(
    camera: Camera, column: Int[np.ndarray, " ..."], row: Int[np.ndarray, " ..."]
) -> Float64[np.ndarray, " ..."]:
    """Distance over planar depth along the rays through pixel centres; the arguments broadcast."""
    x = (column + (0.5 - camera.K[0, 2])) / camera.K[0, 0]
    y = (row + (0.5 - camera.K[1, 2])) / camera.K[1, 1]
    return np.asarray(np.sqrt(x * x + y * y + 1.0))


@dataclass(frozen=True, eq=False)
class PlanarDepth:
    """A map whose planar depth is computed on demand, at the pixels that are used."""

    values: Float32[np.ndarray, "H W"]  # NaN, or not above 0, where depth is unknown
    scale: float  # scene units per unit of ``values``
    along_ray: bool  # whether values are distances along the ray
    camera: Camera  # the image's, in pixels of the map

    @classmethod
    def from_map(
        cls, depth: DepthMap, camera: Camera, scale: float, shift: float, *, unit_ray: bool
    ) -> PlanarDepth:
        """Apply an ``Alignment``'s scale and shift to a map.

        With ``unit_ray``, planar depth counts as distance along the ray, as equation 9 has it.
        """
        if depth.kind != "inverse":
            return cls(depth.values, scale, depth.kind == "ray" or unit_ray, camera)
        inverse = scale * depth.values + shift
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(inverse > 0, 1.0 / inverse, np.nan).astype(np.float32)
        return cls(values, 1.0, unit_ray, camera)

    def strided(self, first: int, step: int) -> Float32[np.ndarray, "h w"]:
        """Planar depth, without the scale, at every ``step``-th row and column."""
        z = self.values[first::step, first::step].copy()
        if self.along_ray:
            row, column = (np.arange(first, size, step) for size in self.values.shape)
            z /= ray_length(self.camera, column, row[:, None]).astype(np.float32)
        z[~(z < np.inf)] = np.nan
        return np.asarray(z)

    def full(self) -> Float64[np.ndarray, "H W"]:
        """Planar depth of all pixels in scene units."""
        return self.strided(0, 1) * np.float64(self.scale)

    def at_pixels(self, pixel: Int64[np.ndarray, " C"]) -> Float32[np.ndarray, " C"]:
        """Planar depth of pixels (row * W + column) in scene units."""
        z = self.values.ravel()[pixel] * self.scale
        if self.along_ray:
            row, column = np.divmod(pixel, self.camera.width)
            z = z / ray_length(self.camera, column, row)
        return np.asarray(z, np.float32)


def lift_pixels(
    pixel: Int64[np.ndarray, " C"],
    z: Float32[np.ndarray, " C"],
    camera: Camera,
    factor: float = 1.0,
) -> Float32[np.ndarray, "C 3"]:
    """Lift pixels (row * W + column) at depth ``factor * z`` to world positions.

    Equation 9: P = c + z v, where v is the ray through the pixel's centre, with unit z in camera
    axes; the text's P = c + s d v / |v| is the same with z = s d / |v|.
    """
    row, column = np.divmod(pixel, camera.width)
    uv = np.stack([column, row], axis=1) + 0.5
    return camera.unproject(uv, factor * z.astype(np.float64)).astype(np.float32)


@dataclass(frozen=True)
class Alignment:
    """Scale and shift from an image's depth map to scene units."""

    scale: float  # scene units per unit of the map; for inverse depth, 1 / scene units
    shift: float  # added after scaling; 0 except for inverse depth
    num_points: int  # SfM points on known depth
    residual: float  # median of their |aligned depth / depth of the point - 1|; NaN without any
    rejected: str | None = None  # reason why the map is not used; None = it is used


def align_maps(
    scene: Scene, *, max_residual_ratio: float | None = 3.0, progress: Progress = silent
) -> dict[str, Alignment]:
    """Align each depth map of a scene to its SfM points, by image name; rejected maps included.

    Maps in the scene's unit keep it where there are too few points.
    ``max_residual_ratio`` is as in ``DepthSettings``.

    Raises:
        SceneNotFoundError: The scene has no maps, or a map's file is gone.
        SceneFormatError: A map cannot be read, or differs from its image in aspect ratio.
    """
    if scene.depths is None:
        raise SceneNotFoundError(
            "a scene with depth maps", found="none", fix="Pass their folder as `depth`."
        )
    depths, visibility = scene.depths, find_visibility(scene)
    images = [image for image in scene.images if image.name in depths]
    found: dict[str, Alignment] = {}

    def work(start: int, stop: int) -> None:
        for image in images[start:stop]:
            depth = depths.read(image.name).reliable(DepthSettings.min_confidence)
            camera = map_camera(depth, image)
            points = points_in_image(camera, visibility.of(image))
            in_units = in_scene_units(depths)
            found[image.name] = align_map(depth, camera, points, in_units=in_units)

    in_threads(work, len(images), 1, "align depth", progress)
    return reject_outliers({image.name: found[image.name] for image in images}, max_residual_ratio)


def align_map(
    depth: DepthMap,
    camera: Camera,
    points: PointsInImage,
    fit: Fit = DepthSettings.fit,
    min_points: int = DepthSettings.min_points,
    *,
    in_units: bool = False,
    unit_ray: bool | None = None,
) -> Alignment:
    """Align one map to the SfM points that its image sees.

    ``camera`` is in pixels of the map. With too few points, a map ``in_units`` of the scene, up to
    a small error, keeps its unit. By default, ``unit_ray`` is set for least squares only, so that
    equation 7 fits the points that equation 9 lifts.
    """
    seen = points
    unit_ray = fit == "least-squares" if unit_ray is None else unit_ray
    value, z, points = _values_at(depth, camera, seen, unit_ray=unit_ray)
    if in_units and len(value) < max(min_points, 1):
        return check_units(depth, camera, seen, unit_ray=unit_ray)
    known = depth.values[np.isfinite(depth.values)]
    rejected = None
    if not known.size:
        rejected = NO_DEPTH
    elif len(value) < max(min_points, 1):
        rejected = f"{len(value)} SfM points on known depth; {max(min_points, 1)} are needed"
    elif np.ptp(known) == 0:
        rejected = "the map has one value everywhere: its estimation failed on this image"
    if rejected is not None:
        return Alignment(np.nan, 0.0, len(value), np.nan, rejected)
    if depth.kind == "inverse":
        scale, shift = (robust_line if fit == "robust" else least_squares_line)(value, z)
    elif fit == "robust":
        scale, shift = median_scale(value, z), 0.0
    else:
        centers = np.floor(points.uv) + 0.5
        raw = value[:, None] * _rays(camera, centers)
        target = points.depth[:, None] * _rays(camera, points.uv)
        scale, shift = least_squares_scale(raw, target), 0.0
    residual = _residual(depth, value, z, scale, shift)
    if depth.kind == "inverse" and not scale > 0:
        rejected = "values rise with depth, so they are not its inverse"
    elif not residual <= LIMITS.max_residual:
        rejected = f"depth is off by {residual:.0%} at half of the SfM points"
    return Alignment(scale, shift, len(value), residual, rejected)


def check_units(
    depth: DepthMap,
    camera: Camera,
    points: PointsInImage,
    *,
    unit_ray: bool = DepthSettings.unit_ray,
) -> Alignment:
    """Check a map in scene units against the SfM points, if there are enough; its scale is 1."""
    value, z, _ = _values_at(depth, camera, points, unit_ray=unit_ray)
    residual, rejected = np.nan, None
    if not np.isfinite(depth.values).any():
        rejected = NO_DEPTH
    elif len(value) >= LIMITS.unit_points:
        residual = _residual(depth, value, z, 1.0, 0.0)
        with np.errstate(divide="ignore"):
            ratio = float(np.median((1.0 / value if depth.kind == "inverse" else value) / z))
        # Depth in millimetres, or of another scene, is off by far more.
        if not 1.0 / LIMITS.unit_factor < ratio < LIMITS.unit_factor:
            rejected = f"its depth is {ratio:.3g} times that of the SfM points"
    return Alignment(1.0, 0.0, len(value), residual, rejected)


def _values_at(
    depth: DepthMap, camera: Camera, points: PointsInImage, *, unit_ray: bool
) -> tuple[Values, Values, PointsInImage]:
    """Map values at the points on known depth, the depths to compare, and these points.

    A point takes the value of the pixel it projects into. Distances along the ray are converted to
    planar depth by the ray through that pixel's centre. Inverse distances cannot be converted
    before their shift is known: the points' planar depths become distances instead.
    """
    column, row = points.uv.astype(np.int64).T
    value, z = depth.values[row, column].astype(np.float64), points.depth
    if depth.kind == "inverse":
        z = z * ray_length(camera, column, row) if unit_ray else z
    elif depth.kind == "ray" or unit_ray:
        value /= ray_length(camera, column, row)
    known = np.isfinite(value) & ((value > 0) | (depth.kind == "inverse"))
    return value[known], z[known], points.select(known)


def _rays(camera: Camera, uv: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M 3"]:
    """Rays of unit z through image positions, in camera axes."""
    return np.column_stack([normalized(camera.K, uv), np.ones(len(uv))])


def _residual(depth: DepthMap, value: Values, z: Values, scale: float, shift: float) -> float:
    """Median relative error of depth; infinite at a point that would lie behind the camera."""
    aligned = scale * value + shift
    if depth.kind == "inverse":
        # Where 1 / z would not be positive there is no depth.
        aligned = 1.0 / np.where(aligned > 0, aligned, np.nan)
    error = np.abs(aligned / z - 1.0)
    return float(np.median(np.where(np.isfinite(error), error, np.inf)))


def reject_other_units(alignments: dict[str, Alignment], min_points: int) -> dict[str, Alignment]:
    """Reject maps taken as they are for lack of points, if those that have points need a scale."""
    few = max(min_points, 1)
    scales = [
        each.scale
        for each in alignments.values()
        if each.rejected is None and each.num_points >= few
    ]
    factor = float(np.median(scales)) if scales else 1.0
    if 1.0 / LIMITS.unit_factor < factor < LIMITS.unit_factor:
        return alignments
    return {
        name: replace(
            each, rejected=f"{each.num_points} SfM points on known depth; {few} are needed"
        )
        if each.rejected is None and each.num_points < few
        else each
        for name, each in alignments.items()
    }


def reject_outliers(
    alignments: dict[str, Alignment], max_ratio: float | None
) -> dict[str, Alignment]:
    """Reject images that fit much worse than the median of those not yet rejected."""
    residuals = [a.residual for a in alignments.values() if a.rejected is None]
    if max_ratio is None or not residuals:
        return alignments
    typical = float(np.median(residuals))
    # The median image is no outlier, and neither is one off by 1%.
    limit = max(max_ratio * typical, LIMITS.good_residual)
    return {
        name: replace(a, rejected=f"depth is off by {a.residual:.1%}, typically {typical:.1%}")
        if a.rejected is None and a.residual > limit
        else a
        for name, a in alignments.items()
    }
