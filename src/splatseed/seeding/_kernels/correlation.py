"""Numba kernel of a patch's normalised correlation with each place of a band."""

import numpy as np

from splatseed.runtime.jit import inline


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
