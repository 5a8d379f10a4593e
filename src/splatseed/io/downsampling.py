"""Downsampling by area: a smaller photograph, mask or alpha, from the pixels of the file.

Notation: a *factor*, 1 or more, divides width and height. A whole one averages blocks of factor x
factor pixels, and cuts off those at the right and lower edge that fill none. With any other the
size is rounded, and a pixel is the mean over its rectangle of the file's, by the area covered.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Shaped


def is_whole(factor: float) -> bool:
    """Whether a factor is a whole number."""
    return float(factor).is_integer()


def reduced_size(width: int, height: int, factor: float) -> tuple[int, int]:
    """Return the width and height of a photograph divided by a factor."""
    if is_whole(factor):
        return width // int(factor), height // int(factor)
    return max(1, round(width / factor)), max(1, round(height / factor))


def reduction(width: int, height: int, factor: float) -> tuple[float, float]:
    """Return the pixels of the smaller photograph per pixel of the file, across and down."""
    if is_whole(factor):
        return 1 / factor, 1 / factor
    columns, rows = reduced_size(width, height, factor)
    return columns / width, rows / height


def area_means(
    pixels: Shaped[np.ndarray, "H W *C"], factor: float
) -> Float64[np.ndarray, "h w *C"]:
    """Return the mean of each pixel's rectangle."""
    height, width = pixels.shape[:2]
    columns, rows = reduced_size(width, height, factor)
    if is_whole(factor):
        side = int(factor)
        cut = pixels[: rows * side, : columns * side]
        return np.asarray(cut.reshape(rows, side, columns, side, *pixels.shape[2:]).mean((1, 3)))
    means: np.ndarray = pixels
    for axis, count in ((0, rows), (1, columns)):
        step = means.shape[axis] / count
        edges = np.arange(count + 1) * step
        whole = np.minimum(edges.astype(np.int64), means.shape[axis] - 1)
        # Sums up to each edge: of the pixels before, and of the covered part of the next.
        exact = np.float64 if means.dtype == np.float64 else np.uint32
        sums = np.cumsum(means, axis=axis, dtype=exact)
        sums = np.concatenate([np.zeros_like(sums.take([0], axis)), sums], axis=axis)
        part = (edges - whole).reshape([-1 if i == axis else 1 for i in range(means.ndim)])
        means = np.diff(sums.take(whole, axis) + part * means.take(whole, axis), axis=axis) / step
    return means
