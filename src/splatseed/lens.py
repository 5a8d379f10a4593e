"""Lens distortion of COLMAP's camera models, in float64, on arrays of any shape.

Normalised coordinates (x, y) stand for the ray (x, y, 1) in camera axes. Distortion maps them to
(u, v), and pixels are (fx u + cx, fy v + cy). Models and parameters are COLMAP's
(src/colmap/sensor/models.h); the first of them are OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.projection import denormalized, normalized
from splatseed.text import quoted


@dataclass(frozen=True)
class DistortionSettings:
    """Constants of the inversion of distortion and of the search for folds."""

    fold_directions: int = 8  # in which a fold is searched for
    fold_samples: int = 1024  # in each direction
    newton_steps: int = 30
    difference: float = 1e-6  # step of finite differences, normalised coordinates
    tolerance: float = 1e-9  # normalised coordinates


DISTORTION = DistortionSettings()


def undistort_advice(scene: Path | None) -> str:
    """Return advice for the user to undistort a scene, with its folder if known.

    Example:
        >>> undistort_advice(Path("my scene"))
        "Undistort the scene first: splatseed undistort 'my scene' -o 'my scene_undistorted'."
    """
    if scene is None:
        return "Undistort the scene first: splatseed undistort SCENE -o OUT."
    return f"Undistort the scene first: {undistort_command(scene)}."


def undistort_command(scene: Path) -> str:
    """Return the command that undistorts the scene in a folder."""
    return f"splatseed undistort {quoted(scene)} -o {quoted(undistorted_folder(scene))}"


def undistorted_folder(scene: Path) -> Path:
    """Return the output folder of ``undistort_command``, next to the scene's folder."""
    folder = scene.parent if scene.is_file() else scene
    named = folder if folder.name else folder.absolute()  # "." has no name
    return named.with_name(f"{folder.resolve().name}_undistorted")


def project_rays(lens: Intrinsics, xy: Float64[np.ndarray, "*B 2"]) -> Float64[np.ndarray, "*B 2"]:
    """Project rays (x, y, 1) to pixels; the centre of the first pixel is (0.5, 0.5)."""
    return denormalized(lens.K, distort(lens, xy))


def distort(lens: Intrinsics, xy: Float64[np.ndarray, "*B 2"]) -> Float64[np.ndarray, "*B 2"]:
    """Apply lens distortion to normalised image coordinates.

    The result is meaningless beyond the image, where the polynomial was not fitted; see
    ``fold_radius``.
    """
    x, y = xy[..., 0], xy[..., 1]
    k = lens.params[CAMERA_MODELS[lens.model].num_focal + 2 :]
    if lens.is_fisheye:
        x, y = _equidistant(x, y)
    if lens.model.endswith("DIVISION"):
        return np.stack(_division(x, y, k[0]), axis=-1)
    if lens.model == "EUCM":
        return np.stack(_unified(x, y, *k), axis=-1)
    if lens.model == "FOV":
        return np.stack(_field_of_view(x, y, k[0]), axis=-1)
    if lens.model == "RAD_TAN_THIN_PRISM_FISHEYE":  # tangential terms apply to the radial result
        x, y = _brown_conrady(x, y, _Terms(radial=k[:6]))
        return np.stack(_brown_conrady(x, y, _Terms(tangential=k[7:5:-1], prism=k[8:])), axis=-1)
    return np.stack(_brown_conrady(x, y, _terms(lens.model, k)), axis=-1)


def unproject_pixels(
    lens: Intrinsics, uv: Float64[np.ndarray, "*B 2"]
) -> Float64[np.ndarray, "*B 2"]:
    """Return the rays (x, y, 1) of pixels: ``project_rays`` inverted by Newton's method.

    NaN where no ray within the lens's fold projects to the pixel.
    """
    goal = normalized(lens.K, uv)
    xy, moves = goal.copy(), DISTORTION.difference * np.eye(2)
    with np.errstate(all="ignore"):  # distant coordinates need not stay finite
        for _ in range(DISTORTION.newton_steps):
            columns = [distort(lens, xy + move) - distort(lens, xy - move) for move in moves]
            (a, c), (b, d) = (
                np.moveaxis(each / (2 * DISTORTION.difference), -1, 0) for each in columns
            )
            residual = goal - distort(lens, xy)
            u, v = residual[..., 0], residual[..., 1]
            xy = xy + np.stack([d * u - b * v, a * v - c * u], axis=-1) / (a * d - b * c)[..., None]
        converged = np.linalg.norm(goal - distort(lens, xy), axis=-1) < DISTORTION.tolerance
    radius = np.where(converged, np.linalg.norm(xy, axis=-1), 0.0)
    converged &= radius <= fold_radius(lens, float(radius.max(initial=0.0)))
    return np.where(converged[..., None], xy, np.nan)


def fold_radius(lens: Intrinsics, limit: float) -> float:
    """Return the normalised radius beyond which the lens folds, or ``limit`` if it is smaller.

    Distortion polynomials are fitted within the image. Beyond it they may decrease, so that distant
    rays would project into the image a second time.
    """
    radius = np.linspace(0.0, limit, DISTORTION.fold_samples + 1)
    angle = np.arange(DISTORTION.fold_directions) * (2 * np.pi / DISTORTION.fold_directions)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None] * radius[:, None]
    with np.errstate(all="ignore"):  # rational models may have poles
        distance = np.linalg.norm(distort(lens, rays) - distort(lens, np.zeros(2)), axis=-1)
        increases = np.all(np.diff(distance, axis=1) > 0, axis=0)
    return float(limit if increases.all() else radius[np.argmin(increases)])


class _Terms(NamedTuple):
    """Coefficients of Brown and Conrady's model."""

    radial: tuple[float, ...] = ()  # of r^2, r^4, ...
    denominator: tuple[float, ...] = ()  # of r^2, r^4, ...
    tangential: tuple[float, ...] = (0.0, 0.0)  # p1, p2
    prism: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)  # of r^2 and r^4 for u, then for v


def _terms(model: str, k: tuple[float, ...]) -> _Terms:
    """Sort a model's distortion parameters into terms."""
    match model:
        case "OPENCV":
            return _Terms(k[:2], tangential=k[2:])
        case "FULL_OPENCV":
            return _Terms((*k[:2], k[4]), k[5:], k[2:4])
        case "THIN_PRISM_FISHEYE":
            return _Terms((*k[:2], *k[4:6]), tangential=k[2:4], prism=(k[6], 0.0, k[7], 0.0))
        case _:
            return _Terms(k)  # radial only, or none


Plane = tuple[np.ndarray, np.ndarray]
"""First and second normalised coordinates."""


def _brown_conrady(x: np.ndarray, y: np.ndarray, terms: _Terms) -> Plane:
    """Apply Brown and Conrady's model, with a denominator and a thin prism."""
    p1, p2 = terms.tangential
    a1, a2, b1, b2 = terms.prism
    r2 = x * x + y * y
    # radial = (1 + k1 r^2 + k2 r^4 + ...) / (1 + k4 r^2 + ...)
    radial = _polynomial(r2, terms.radial) / _polynomial(r2, terms.denominator)
    # u = x radial + 2 p1 x y + p2 (r^2 + 2 x^2) + a1 r^2 + a2 r^4, and v likewise
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (a1 + r2 * a2)
    v = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) + r2 * (b1 + r2 * b2)
    return u, v


def _polynomial(t: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Evaluate 1 + c1 t + c2 t^2 + ... by Horner's rule."""
    total = np.zeros_like(t)
    for coefficient in reversed(coefficients):
        total = t * (coefficient + total)
    return 1 + total


def _equidistant(x: np.ndarray, y: np.ndarray) -> Plane:
    """Apply the fisheye projection: the image radius is the angle from the axis, atan r."""
    r = np.hypot(x, y)
    scale = np.divide(np.arctan(r), r, out=np.ones_like(r), where=r > 0)
    return x * scale, y * scale


def _field_of_view(x: np.ndarray, y: np.ndarray, omega: float) -> Plane:
    """Apply Devernay and Faugeras's model: image radius atan(2 r tan(omega / 2)) / omega."""
    if not omega:
        return x, y
    r = np.hypot(x, y)
    slope = 2 * np.tan(omega / 2)
    scale = np.full_like(r, slope / omega)  # the limit at r = 0
    np.divide(np.arctan(r * slope), r * omega, out=scale, where=r > 0)
    return x * scale, y * scale


def _division(x: np.ndarray, y: np.ndarray, k: float) -> Plane:
    """Apply Fitzgibbon's model, in which (u, v) lies on the ray (u, v, 1 + k (u^2 + v^2)).

    NaN for k > 0 and radii beyond 1 / (2 sqrt k).
    """
    # The ratio s of image radius to r solves k r^2 s^2 - s + 1 = 0.
    with np.errstate(invalid="ignore"):
        scale = 2 / (1 + np.sqrt(1 - 4 * k * (x * x + y * y)))
    return x * scale, y * scale


def _unified(x: np.ndarray, y: np.ndarray, alpha: float, beta: float) -> Plane:
    """Apply Khomutenko, Garcia and Martinet's enhanced unified camera model."""
    denominator = alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha
    return x / denominator, y / denominator
