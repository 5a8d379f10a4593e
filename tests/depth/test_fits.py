"""Scales and lines through depth values, held to planted truth and to literal loops."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.depth.fits import (
    least_squares_line,
    least_squares_scale,
    median_scale,
    robust_line,
)


def planted(rng, num=300, outliers=0.2, noise=0.005):
    """Depths 1..6, with noise and gross outliers; values are still to be made of the clean ones."""
    clean = rng.uniform(1.0, 6.0, num)
    z = clean * (1.0 + noise * rng.normal(size=num))
    wrong = rng.permutation(num)[: int(outliers * num)]
    z[wrong] *= rng.choice([0.3, 0.5, 2.0, 3.0], len(wrong))
    return clean, z


def test_equation_7_is_a_loop_over_points(rng):
    value, z = rng.uniform(1.0, 5.0, (2, 40))
    best = min(
        (sum((s * d - t) ** 2 for d, t in zip(value, z, strict=True)), s)
        for s in np.linspace(0.2, 3.0, 28_001)
    )[1]
    numerator = denominator = 0.0
    for d, t in zip(value.tolist(), z.tolist(), strict=True):
        numerator += d * t
        denominator += d * d
    assert least_squares_scale(value, z) == pytest.approx(numerator / denominator, rel=1e-12)
    assert least_squares_scale(value, z) == pytest.approx(best, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [1e-3, 0.37, 5000.0])
def test_a_planted_scale_survives_outliers(seed, scale):
    clean, z = planted(np.random.default_rng(seed))
    assert median_scale(clean / scale, z) == pytest.approx(scale, rel=0.005)
    assert abs(least_squares_scale(clean / scale, z) / scale - 1) > 0.05


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("a", "b"), [(2.0, 0.1), (1e-3, -0.05), (0.5, 0.0)])
def test_a_planted_scale_and_shift_survive_outliers(seed, a, b):
    clean, z = planted(np.random.default_rng(seed))
    value = (1.0 / clean - b) / a
    scale, shift = robust_line(value, z)
    fitted = 1.0 / (scale * value + shift)
    assert scale == pytest.approx(a, rel=0.005)
    np.testing.assert_allclose(fitted, clean, rtol=0.005)
    plain = least_squares_line(value, z)
    assert abs(plain[0] / a - 1) > 0.02


def test_without_outliers_the_line_is_that_of_least_squares(rng):
    clean = rng.uniform(1.0, 6.0, 50)
    value = (1.0 / clean - 0.1) / 2.0
    for scale, shift in (robust_line(value, clean), least_squares_line(value, clean)):
        assert (scale, shift) == pytest.approx((2.0, 0.1), rel=1e-9)
    slope, intercept = np.polyfit(value, 1.0 / clean**1.1, 1)
    assert least_squares_line(value, clean**1.1) == pytest.approx((slope, intercept), rel=1e-9)


@pytest.mark.parametrize("num", [1, 2, 5])
def test_values_that_do_not_differ_give_no_slope(num):
    scale, shift = robust_line(np.full(num, 0.5), np.full(num, 4.0))
    assert (scale, shift) == (0.0, 0.25)


@given(st.integers(0, 2**32 - 1), st.integers(-20, 20))
@settings(max_examples=25, deadline=None)
def test_a_power_of_two_goes_through_exactly(seed, exponent):
    rng = np.random.default_rng(seed)
    value, z = rng.uniform(0.1, 9.0, (2, 30))
    factor = 2.0**exponent
    assert median_scale(value, z * factor) == factor * median_scale(value, z)
    assert least_squares_scale(value, z * factor) == factor * least_squares_scale(value, z)
    scale, shift = robust_line(value, z)
    assert robust_line(value, z * factor) == (scale / factor, shift / factor)
