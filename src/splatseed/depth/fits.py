"""Robust and least-squares fits that take depth values to scene units.

Notation: at M SfM points, ``value`` is what the map holds and ``z`` the planar depth of the point,
both positive, float64 [M]. A scale s means z = s value. A line (a, b) means 1 / z = a value + b:
networks of the MiDaS kind predict depth's inverse up to scale and shift. Promise: nothing is
random; multiplying ``z`` by a power of two divides or multiplies the result by it exactly.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from splatseed.kernels.jit import inline

PAIRS = 256
"""Pairs of points whose lines are tried; nothing is random, as they follow the R2 sequence."""
GOLDEN = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of the R2 sequence, which fills a square evenly (Roberts, 2018)."""
TUKEY = 4.685
"""Tukey's biweight at 95% efficiency, in standard deviations."""
STEPS = 20
"""Most steps of reweighting."""
SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation of a normal variable over the median of its absolute value."""

Values = Float64[np.ndarray, " M"]


@inline
def median(values):  # type: ignore[no-untyped-def]  # Numba's types
    """NumPy's median for float64 without NaN, without its overhead on a thousand values."""
    return np.median(values)


def least_squares_scale(value: Values, z: Values) -> float:
    """The s that minimises sum (s value - z)^2: the paper's equation 7."""
    return float(value @ z / (value @ value))


def median_scale(value: Values, z: Values) -> float:
    """The median of z / value: up to half of the points may be wrong."""
    return float(median(z / value))


def least_squares_line(value: Values, z: Values) -> tuple[float, float]:
    """The (a, b) that minimise sum (a value + b - 1 / z)^2."""
    return _solve(value, 1.0 / z, np.ones_like(z))


def robust_line(value: Values, z: Values) -> tuple[float, float]:
    """The (a, b) that most points agree with, by relative error r = z (a value + b) - 1.

    Of the lines through 256 pairs of points, the one whose errors have the least median is refined
    by iteratively reweighted least squares with Tukey's biweight, as LO-RANSAC refines its best
    sample.
    """
    line = _best_of_pairs(value, 1.0 / z)
    floor = 1e-6  # an exact fit must not divide by zero
    for _ in range(STEPS):
        r = z * (line[0] * value + line[1]) - 1.0
        sigma = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(r))), floor)
        # Tukey's biweight (1 - u^2)^2, 0 from 4.685 sigma on
        u = np.minimum(np.abs(r) / (TUKEY * sigma), 1.0)
        # The residual is relative, so a point's weight on 1 / z also has the factor z squared.
        line, before = _solve(value, 1.0 / z, (1.0 - u * u) ** 2 * z * z), line
        if np.allclose(line, before, rtol=1e-9, atol=0.0):
            break
    return line


def _best_of_pairs(value: Values, inverse: Values) -> tuple[float, float]:
    """The line through two points with the smallest median of relative errors."""
    order = np.argsort(value, kind="stable")
    steps = (np.arange(1, PAIRS + 1)[:, None] * GOLDEN) % 1.0
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


def _solve(value: Values, target: Values, weight: Values) -> tuple[float, float]:
    """Weighted least squares of target = a value + b, about the weighted means for accuracy."""
    # a = cov(value, target) / var(value), b = mean target - a mean value
    weight = weight / weight.sum()
    mean_value, mean_target = weight @ value, weight @ target
    spread = weight @ (value - mean_value) ** 2
    if not spread > 0:
        return 0.0, float(mean_target)
    a = weight @ ((value - mean_value) * (target - mean_target)) / spread
    return float(a), float(mean_target - a * mean_value)
