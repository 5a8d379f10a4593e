"""L1 and SSIM of two images with their gradient, on the CPU, in one pass over the rows.

Notation: x the render, y the truth, [H, W, 3] with interleaved channels; G the 11 x 11 Gaussian
window of standard deviation 1.5, applied where it fits whole ("valid"); mu_x = G*x, e_xy = G*(xy),
e_2 = G*(x^2 + y^2). With A1 = 2 mu_x mu_y + C1, A2 = 2 (e_xy - mu_x mu_y) + C2,
B1 = mu_x^2 + mu_y^2 + C1, B2 = e_2 - mu_x^2 - mu_y^2 + C2,

    SSIM = A1 A2 / (B1 B2)                                  (Wang et al. 2004, eq. 13)

needs four windowed means, as the two variances appear only as a sum. Its derivatives are

    dS/dmu_x = 2 (mu_y (A2 - A1) + S mu_x (B1 - B2)) / (B1 B2)
    dS/de_xy = 2 A1 / (B1 B2),   dS/de_2 = -S / B2

and the gradient of the sum of S is G'*dS/dmu_x + y G'*dS/de_xy + 2 x G'*dS/de_2.

Promise: sums have a fixed order, so the bytes do not depend on the number of threads. A row of
interleaved channels is one contiguous vector whose taps lie 3 apart, which LLVM vectorises.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from splatseed.jit import inline, kernel, parallel_range

__all__ = ["WINDOW", "l1_and_ssim", "window_weights"]

WINDOW = 11
SIGMA = 1.5
C1 = np.float32(0.01**2)
C2 = np.float32(0.03**2)
HALF = WINDOW // 2
MARGIN = WINDOW - 1
STRIP = 8
"""Rows that one task works on; fixed, so that sums do not depend on the threads."""


def window_weights() -> Float32[np.ndarray, " 11"]:
    """The one-dimensional Gaussian window, float32 [11], of sum 1."""
    offset = np.arange(WINDOW) - HALF
    weights = np.exp(-(offset**2) / (2 * SIGMA**2))
    return np.asarray(weights / weights.sum(), np.float32)


def l1_and_ssim(
    render: Float32[np.ndarray, "H W 3"],
    truth: Float32[np.ndarray, "H W 3"],
    l1_weight: float,
    ssim_weight: float,
) -> tuple[float, float, Float32[np.ndarray, "H W 3"]]:
    """Mean |x - y|, mean SSIM, and the gradient of a mixture of them.

    Args:
        render: x, values about 0..1, contiguous; at least 11 pixels a side.
        truth: y, likewise.
        l1_weight: Weight of the mean absolute difference.
        ssim_weight: Weight of 1 - SSIM.

    Returns:
        The two means, and d(l1_weight L1 + ssim_weight (1 - SSIM)) / dx.
    """
    height, width, channels = render.shape
    x, y = render.reshape(height, -1), truth.reshape(height, -1)
    rows, columns = height - MARGIN, (width - MARGIN) * channels
    partials = np.empty((3, rows, columns), np.float32)
    ssim_sums = np.empty(-(-rows // STRIP), np.float64)
    l1_sums = np.empty(-(-height // STRIP), np.float64)
    gradient = np.empty_like(x)
    weights = window_weights()
    _forward(x, y, weights, partials, ssim_sums)
    ssim_scale = np.float32(-ssim_weight / (rows * columns))
    l1_scale = np.float32(l1_weight / x.size)
    _backward(x, y, weights, partials, ssim_scale, l1_scale, l1_sums, gradient)
    l1, ssim = l1_sums.sum() / x.size, ssim_sums.sum() / (rows * columns)
    return float(l1), float(ssim), gradient.reshape(render.shape)


@inline
def _blur_row(source, weights, out):
    """out[i] = sum_k weights[k] source[i + 3 k], folded at the centre as the window is even."""
    for i in range(len(out)):
        total = weights[5] * source[i + 15]
        total += weights[4] * (source[i + 12] + source[i + 18])
        total += weights[3] * (source[i + 9] + source[i + 21])
        total += weights[2] * (source[i + 6] + source[i + 24])
        total += weights[1] * (source[i + 3] + source[i + 27])
        total += weights[0] * (source[i] + source[i + 30])
        out[i] = total


@inline
def _add_rows(x0, y0, x1, y1, weight, sums):
    """Add a pair of rows at the same distance from the centre to the four vertical means."""
    for i in range(len(x0)):
        a, b, c, d = x0[i], y0[i], x1[i], y1[i]
        sums[0, i] += weight * (a + c)
        sums[1, i] += weight * (b + d)
        sums[2, i] += weight * (a * b + c * d)
        sums[3, i] += weight * ((a * a + b * b) + (c * c + d * d))


@inline
def _similarity(means, partials, row, totals):
    """SSIM and its three derivatives along one row of windowed means."""
    two = np.float32(2.0)
    for i in range(means.shape[1]):
        mx, my, exy, e2 = means[0, i], means[1, i], means[2, i], means[3, i]
        a1 = two * mx * my + C1
        a2 = two * (exy - mx * my) + C2
        squares = mx * mx + my * my
        b1 = squares + C1
        b2 = e2 - squares + C2
        inverse = np.float32(1.0) / (b1 * b2)
        ssim = a1 * a2 * inverse
        partials[0, row, i] = two * inverse * (my * (a2 - a1) + ssim * mx * (b1 - b2))
        partials[1, row, i] = two * inverse * a1
        partials[2, row, i] = -ssim * inverse * b1
        totals[i] += ssim


@kernel
def _forward(x, y, weights, partials, ssim_sums):
    """Fill the derivative maps [3, H-10, (W-10)*3] and the sum of SSIM of each strip."""
    rows, columns = partials.shape[1], partials.shape[2]
    for strip in parallel_range(len(ssim_sums)):
        sums = np.empty((4, x.shape[1]), np.float32)
        means = np.empty((4, columns), np.float32)
        totals = np.zeros(columns, np.float32)
        for row in range(strip * STRIP, min((strip + 1) * STRIP, rows)):
            sums[:] = np.float32(0.0)
            middle = row + HALF
            half = np.float32(0.5) * weights[HALF]
            _add_rows(x[middle], y[middle], x[middle], y[middle], half, sums)
            for k in range(HALF):
                low, high = row + k, row + MARGIN - k
                _add_rows(x[low], y[low], x[high], y[high], weights[k], sums)
            for m in range(4):
                _blur_row(sums[m], weights, means[m])
            _similarity(means, partials, row, totals)
        total = 0.0
        for i in range(columns):
            total += totals[i]
        ssim_sums[strip] = total


@inline
def _add_partials(partials, source, weight, margin, sums):
    for m in range(3):
        from_row, to_row = partials[m, source], sums[m]
        for i in range(len(from_row)):
            to_row[margin + i] += weight * from_row[i]


@inline
def _combine(x, y, blurred, ssim_scale, l1_scale, gradient, differences):
    """The gradient along one row, from the three blurred derivative rows."""
    two = np.float32(2.0)
    for i in range(len(x)):
        difference = x[i] - y[i]
        ssim_part = blurred[0, i] + y[i] * blurred[1, i] + two * x[i] * blurred[2, i]
        gradient[i] = ssim_scale * ssim_part + l1_scale * np.sign(difference)
        differences[i] += abs(difference)


@kernel
def _backward(x, y, weights, partials, ssim_scale, l1_scale, l1_sums, gradient):
    """The gradient, and the sum of |x - y| of each strip of rows."""
    height, width = x.shape
    rows, columns = partials.shape[1], partials.shape[2]
    margin = width - columns
    for strip in parallel_range(len(l1_sums)):
        sums = np.empty((3, width + margin), np.float32)
        blurred = np.empty((3, width), np.float32)
        differences = np.zeros(width, np.float32)
        for row in range(strip * STRIP, min((strip + 1) * STRIP, height)):
            sums[:] = np.float32(0.0)
            for k in range(WINDOW):
                source = row + k - MARGIN
                if 0 <= source < rows:
                    _add_partials(partials, source, weights[k], margin, sums)
            for m in range(3):
                _blur_row(sums[m], weights, blurred[m])
            _combine(x[row], y[row], blurred, ssim_scale, l1_scale, gradient[row], differences)
        total = 0.0
        for i in range(width):
            total += differences[i]
        l1_sums[strip] = total
