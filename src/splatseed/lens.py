"""Lens distortion: where rays of the pinhole camera meet the image of a real lens.

Notation: a ray (x, y, 1) in camera axes is named by its place (x, y) on the plane at depth 1; the
lens moves it to another place (u, v) there, and pixels are (fx u + cx, fy v + cy). Parameters are
those of COLMAP's camera models, by its definitions (src/colmap/sensor/models.h), the first of which
are OpenCV's.
Promise: float64; pure functions of arrays of any shape.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.text import quoted

DIRECTIONS, STEPS = 8, 1024
"""Number of rays along which a fold is searched for, and of samples on each."""
TRIES, DIFFERENCE, ARRIVED = 30, 1e-6, 1e-9
"""Newton's method: its steps, the step of finite differences, and the tolerance."""


def undistort_advice(scene: Path | None) -> str:
    """Advice for the user whose scene must not have distortion; its folder, if that is known.

    Example:
        >>> undistort_advice(Path("my scene"))
        "Undistort the scene first: splatseed undistort 'my scene' -o 'my scene_undistorted'."
    """
    if scene is None:
        return "Undistort the scene first: splatseed undistort SCENE -o OUT."
    return f"Undistort the scene first: {undistort_command(scene)}."


def undistort_command(scene: Path) -> str:
    """The command that removes distortion from the scene in a folder."""
    return f"splatseed undistort {quoted(scene)} -o {quoted(undistorted_folder(scene))}"


def undistorted_folder(scene: Path) -> Path:
    """Where that command writes: beside the scene."""
    return scene.with_name(f"{scene.resolve().name}_undistorted")


def project_rays(lens: Intrinsics, xy: Float64[np.ndarray, "*B 2"]) -> Float64[np.ndarray, "*B 2"]:
    """Pixel coordinates of rays (x, y, 1); the first pixel's centre is (0.5, 0.5)."""
    K = lens.K
    return np.asarray(distort(lens, xy) * K[[0, 1], [0, 1]] + K[:2, 2])


def distort(lens: Intrinsics, xy: Float64[np.ndarray, "*B 2"]) -> Float64[np.ndarray, "*B 2"]:
    """Where the lens, but for its focal length and centre, moves points on the plane at depth 1.

    Far out, where the polynomial has lost its meaning, the result is meaningless too.
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
        x, y = _moved(x, y, _Terms(radial=k[:6]))
        return np.stack(_moved(x, y, _Terms(tangential=k[7:5:-1], prism=k[8:])), axis=-1)
    return np.stack(_moved(x, y, _terms(lens.model, k)), axis=-1)


def unproject_pixels(
    lens: Intrinsics, uv: Float64[np.ndarray, "*B 2"]
) -> Float64[np.ndarray, "*B 2"]:
    """The rays (x, y, 1) that a lens maps to pixels: ``project_rays`` inverted by Newton's method.

    Points on the plane at depth 1; NaN where no ray within the lens's fold leads there.
    """
    K = lens.K
    goal = (np.asarray(uv, np.float64) - K[:2, 2]) / K[[0, 1], [0, 1]]
    xy, ahead = goal.copy(), DIFFERENCE * np.eye(2)
    with np.errstate(all="ignore"):  # values far out need not be finite
        for _ in range(TRIES):
            columns = [distort(lens, xy + move) - distort(lens, xy - move) for move in ahead]
            (a, c), (b, d) = (np.moveaxis(each / (2 * DIFFERENCE), -1, 0) for each in columns)
            left = goal - distort(lens, xy)
            u, v = left[..., 0], left[..., 1]
            xy = xy + np.stack([d * u - b * v, a * v - c * u], axis=-1) / (a * d - b * c)[..., None]
        there = np.linalg.norm(goal - distort(lens, xy), axis=-1) < ARRIVED
    radius = np.where(there, np.linalg.norm(xy, axis=-1), 0.0)
    there &= radius <= fold_radius(lens, float(radius.max(initial=0.0)))
    return np.where(there[..., None], xy, np.nan)


def fold_radius(lens: Intrinsics, most: float) -> float:
    """The distance from (0, 0) at which the lens folds: rays farther out would land nearer again.

    Polynomials are fitted within the image; beyond it they turn back sooner or later, and would
    show the image a second time. ``most`` if there is no fold up to there.
    """
    radius = np.linspace(0.0, most, STEPS + 1)
    angle = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None] * radius[:, None]
    with np.errstate(all="ignore"):  # a rational model may have poles out there
        reached = np.linalg.norm(distort(lens, rays) - distort(lens, np.zeros(2)), axis=-1)
        grows = np.all(np.diff(reached, axis=1) > 0, axis=0)
    return float(most if grows.all() else radius[np.argmin(grows)])


class _Terms(NamedTuple):
    """A lens's coefficients: of r^2, r^4, ... in numerator and denominator, p1 and p2, a prism's.

    The prism's multiply r^2 and r^4, first for u, then for v.
    """

    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, ...] = (0.0, 0.0)
    prism: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)


def _terms(model: str, k: tuple[float, ...]) -> _Terms:
    """A model's parameters, sorted into terms."""
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
"""First and second coordinates of points on the plane."""


def _moved(x: np.ndarray, y: np.ndarray, terms: _Terms) -> Plane:
    """Brown and Conrady's model, with a denominator and a thin prism."""
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
    """1 + c1 t + c2 t^2 + ..., by Horner's rule."""
    total = np.zeros_like(t)
    for coefficient in reversed(coefficients):
        total = t * (coefficient + total)
    return 1 + total


def _equidistant(x: np.ndarray, y: np.ndarray) -> Plane:
    """A fisheye: the image radius is the angle from the axis, theta = atan r."""
    r = np.hypot(x, y)
    scale = np.divide(np.arctan(r), r, out=np.ones_like(r), where=r > 0)
    return x * scale, y * scale


def _field_of_view(x: np.ndarray, y: np.ndarray, omega: float) -> Plane:
    """Devernay and Faugeras: the image radius is atan(2 r tan(omega / 2)) / omega."""
    if not omega:
        return x, y
    r = np.hypot(x, y)
    slope = 2 * np.tan(omega / 2)
    scale = np.full_like(r, slope / omega)  # the limit at r = 0
    np.divide(np.arctan(r * slope), r * omega, out=scale, where=r > 0)
    return x * scale, y * scale


def _division(x: np.ndarray, y: np.ndarray, k: float) -> Plane:
    """Fitzgibbon: a point (u, v) of the image is of the ray (u, v, 1 + k (u^2 + v^2)).

    With k > 0 rays beyond 1 / (2 sqrt k) have no image: NaN.
    """
    # s = radius in the image / radius r on the plane solves k r^2 s^2 - s + 1 = 0.
    with np.errstate(invalid="ignore"):
        scale = 2 / (1 + np.sqrt(1 - 4 * k * (x * x + y * y)))
    return x * scale, y * scale


def _unified(x: np.ndarray, y: np.ndarray, alpha: float, beta: float) -> Plane:
    """Khomutenko, Garcia and Martinet's enhanced unified camera model, of a ray (x, y, 1)."""
    denominator = alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha
    return x / denominator, y / denominator
