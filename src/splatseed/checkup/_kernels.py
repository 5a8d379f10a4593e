"""Numba kernels: bands of a photograph, and where in them patches and points are found again."""

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


@inline
def _vertex(before: float, best: float, after: float) -> float:
    """Where a parabola through three correlations has its peak, from the middle one."""
    bend = 2.0 * best - before - after
    return 0.5 * (after - before) / bend if bend > 0.0 else 0.0


@inline
def find_points(
    first: np.ndarray,  # float64 [H, W]
    second: np.ndarray,  # float64 [H, W]
    uv: np.ndarray,  # float64 [M, 2], pixels of points in the first
    depth: np.ndarray,  # float64 [M], in the first
    turn: np.ndarray,  # float64 [3, 3]: K_j R K_i^-1
    shift: np.ndarray,  # float64 [3]: K_j t
    half: int,
    reach: int,
    min_contrast: float,
) -> np.ndarray:  # float64 [M, 3]
    """Return how far from its expected place each point is found in the second, and how well.

    The patch of ``2 half + 1`` pixels a side is carried over by the plane through the point that
    faces the first view, and searched for within ``reach`` pixels. Columns and rows, in pixels of
    the first view, are those of the peak of a parabola, but whole ones at the border of what is
    searched; then the correlation. NaN where the patch is bare, or leaves the first photograph.
    """
    places = np.full((len(uv), 3), np.nan)
    side = 2 * half + 1
    for n in range(len(uv)):
        x, y = np.empty((side, side)), np.empty((side, side))
        for a in range(side):
            for b in range(side):
                x[a, b] = uv[n, 0] + b - half - 0.5
                y[a, b] = uv[n, 1] + a - half - 0.5
        patch = interpolate(first, x, y)
        if not patch.std() >= min_contrast:  # NaN at the border
            continue
        wide = side + 2 * reach
        x, y = np.full((wide, wide), -1.0), np.full((wide, wide), -1.0)
        for a in range(wide):
            for b in range(wide):
                u, v = uv[n, 0] + b - half - reach, uv[n, 1] + a - half - reach
                w = depth[n] * (turn[2, 0] * u + turn[2, 1] * v + turn[2, 2]) + shift[2]
                if w > 0.0:
                    column = depth[n] * (turn[0, 0] * u + turn[0, 1] * v + turn[0, 2]) + shift[0]
                    row = depth[n] * (turn[1, 0] * u + turn[1, 1] * v + turn[1, 2]) + shift[1]
                    x[a, b], y[a, b] = column / w - 0.5, row / w - 0.5
        scores = correlate_patch(patch, interpolate(second, x, y))
        best = np.argmax(scores)
        a, b = best // scores.shape[1], best % scores.shape[1]
        places[n, 0], places[n, 1], places[n, 2] = b - reach, a - reach, scores[a, b]
        if 0 < b < 2 * reach:
            places[n, 0] += _vertex(scores[a, b - 1], scores[a, b], scores[a, b + 1])
        if 0 < a < 2 * reach:
            places[n, 1] += _vertex(scores[a - 1, b], scores[a, b], scores[a + 1, b])
    return places
