"""Numba kernels: bands of a photograph, and a patch's normalised correlation with their places."""

import numpy as np

from splatseed.runtime.jit import inline


@inline
def interpolate(
    image: np.ndarray,  # float64 [H, W]
    x: np.ndarray,  # float64 [A, B], columns, with the centre of the first pixel at 0
    y: np.ndarray,  # float64 [A, B], rows
) -> np.ndarray:  # float64 [A, B]
    """Interpolate an image bilinearly; NaN outside of the centres of its outermost pixels."""
    result = np.full(x.shape, np.nan)
    height, width = image.shape
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            u, v = x[i, j], y[i, j]
            if 0.0 <= u <= width - 1 and 0.0 <= v <= height - 1:
                column, row = min(int(u), width - 2), min(int(v), height - 2)
                s, t = u - column, v - row
                upper = (1.0 - s) * image[row, column] + s * image[row, column + 1]
                lower = (1.0 - s) * image[row + 1, column] + s * image[row + 1, column + 1]
                result[i, j] = (1.0 - t) * upper + t * lower
    return result


@inline
def correlate_patch(
    patch: np.ndarray,  # float64 [P, P]
    band: np.ndarray,  # float64 [A, B], NaN where unknown
) -> np.ndarray:  # float64 [A - P + 1, B - P + 1]
    """Return sum (a - mean a) (b - mean b) / (norm norm) at each place.

    -1 where the band is unknown. The innermost loops run over places, so that they are vectorised
    without reordering a sum.
    """
    side = len(patch)
    height, width = len(band), band.shape[1] - side + 1
    # Sums along the rows of known values, of their squares, and of unknown places.
    rows = np.zeros((3, height, width))
    filled = np.empty(band.shape)
    for i in range(height):
        for j in range(band.shape[1]):
            filled[i, j] = band[i, j] if np.isfinite(band[i, j]) else 0.0
        for b in range(side):
            for j in range(width):
                value = filled[i, j + b]
                rows[0, i, j] += value
                rows[1, i, j] += value * value
                rows[2, i, j] += 0.0 if np.isfinite(band[i, j + b]) else 1.0
    centred = patch - patch.mean()
    norm = np.sqrt((centred * centred).sum())
    scores = np.zeros((height - side + 1, width))
    sums = np.empty((3, width))
    for i in range(len(scores)):
        sums[:] = 0.0
        for a in range(side):
            for j in range(width):
                sums[0, j] += rows[0, i + a, j]
                sums[1, j] += rows[1, i + a, j]
                sums[2, j] += rows[2, i + a, j]
            for b in range(side):
                # The sum of a is 0, so that b's mean need not be subtracted.
                for j in range(width):
                    scores[i, j] += centred[a, b] * filled[i + a, j + b]
        for j in range(width):
            mean = sums[0, j] / patch.size
            variance = max(sums[1, j] / patch.size - mean * mean, 1e-6)
            known = sums[2, j] == 0.0
            scores[i, j] = scores[i, j] / (np.sqrt(variance * patch.size) * norm) if known else -1.0
    return scores
