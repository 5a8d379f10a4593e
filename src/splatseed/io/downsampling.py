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
    across = _means_down(_means_down(pixels, rows).swapaxes(0, 1), columns)
    return np.ascontiguousarray(across.swapaxes(0, 1))


def _means_down(pixels: Shaped[np.ndarray, "H ..."], count: int) -> Float64[np.ndarray, "h ..."]:
    """Return the means of ``count`` equal parts of the rows, each a row long or more."""
    step = len(pixels) / count
    edges = np.arange(count) * step
    first = edges.astype(np.int64)  # the row in which a part begins
    before = (edges - first).reshape(-1, *[1] * (pixels.ndim - 1)) * pixels[first]
    kind = np.float64 if pixels.dtype == np.float64 else np.uint32
    sums = np.add.reduceat(pixels, first, axis=0, dtype=kind) - before
    sums[:-1] += before[1:]
    return np.asarray(sums / step)
