"""Initial planes, through the Structure-from-Motion points near each pixel.

Notation: a view sees M points at pixels uv [M, 2] with inverse depth w [M]; the grid has h x w
points. Promise: K guesses per grid point, finite and positive; if a view sees too few points,
inverse depths drawn uniformly between the bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial import cKDTree

NEAREST = 3
"""Points whose depth is tried as a fronto-parallel plane."""
FITTED = 8
"""Points that a plane is fitted through."""
RANDOM = 16
"""Guesses where nothing is known."""
MARGIN = 1.3
"""Bounds reach this many times beyond the nearest and the farthest point."""
RIDGE = 1e-3
"""Shrinks slopes, relative to the spread of the points: a few in a line do not determine them."""


@dataclass(frozen=True, eq=False)
class Hints:
    """What is known about the depth in a view before stereo.

    Args:
        uv: Pixels of points that it sees, float64 [M, 2].
        w: Their inverse depths, float64 [M].
        bounds: Smallest and largest inverse depth that is searched, float32 [2].
    """

    uv: Float64[np.ndarray, "M 2"]
    w: Float64[np.ndarray, " M"]
    bounds: Float32[np.ndarray, " 2"]


def hints_from(uv: Float64[np.ndarray, "M 2"], w: Float64[np.ndarray, " M"]) -> Hints:
    """Hints from at least one point: planes are searched a little beyond the points."""
    # Percentiles, as a few of SfM's points float in front of the cameras.
    low, high = np.percentile(w, [0.5, 99.5])
    return Hints(uv, w, np.array([low / MARGIN, high * MARGIN], np.float32))


def first_planes(
    hints: Hints, shape: tuple[int, int], grid: int, rng: np.random.Generator
) -> Float32[np.ndarray, "K 3 h w"]:
    """The planes to try first at each grid point.

    Args:
        hints: The view's hints.
        shape: Rows and columns of the grid, neither 0.
        grid: Pixels between grid points.
        rng: For guesses where too few points are seen.
    """
    rows, columns = shape
    w = hints.w
    if len(w) < FITTED:
        guesses = np.zeros((RANDOM, 3, rows, columns), np.float32)
        guesses[:, 0] = rng.uniform(hints.bounds[0], hints.bounds[1], (RANDOM, rows, columns))
        return guesses
    place = (np.indices(shape)[::-1].reshape(2, -1).T + 0.5) * grid
    nearest = cKDTree(hints.uv).query(place, FITTED)[1]
    guesses = np.zeros((NEAREST + 1, 3, rows * columns), np.float32)
    guesses[:NEAREST, 0] = w[nearest[:, :NEAREST]].T
    guesses[NEAREST] = _fit(hints.uv[nearest] - place[:, None], w[nearest])
    return np.ascontiguousarray(guesses.reshape(-1, 3, rows, columns))


def _fit(
    apart: Float64[np.ndarray, "G K 2"], w: Float64[np.ndarray, "G K"]
) -> Float64[np.ndarray, "3 G"]:
    """Least-squares w + gx du + gy dv through K points each, slopes shrunk a little to 0."""
    design = np.concatenate([np.ones((*w.shape, 1)), apart], axis=2)
    normal = np.swapaxes(design, 1, 2) @ design
    spread = np.trace(normal[:, 1:, 1:], axis1=1, axis2=2)
    # Normal equations of w0 + gx du + gy dv; only the slopes are shrunk.
    normal[:, [1, 2], [1, 2]] += RIDGE * (1.0 + spread)[:, None]
    right = np.swapaxes(design, 1, 2) @ w[..., None]
    fitted = np.linalg.solve(normal, right)[..., 0].T
    low, high = w.min(axis=1), w.max(axis=1)
    # Extrapolated planes can leave the points' depths, or end behind the camera.
    outside = (fitted[0] < low / MARGIN) | (fitted[0] > high * MARGIN)
    fitted[:, outside] = [w[outside].mean(axis=1), np.zeros(outside.sum()), np.zeros(outside.sum())]
    return np.asarray(fitted)
