"""Whether other views confirm a point, or look through it.

Notation: at a point that falls into another view's frame at planar depth z, that view has its own
depth d at the four grid points around it. The view *confirms* the point if |d - z| <= tolerance z
for one of them and the colours of both views there are close; it *looks through* the point if all
four d are clearly farther. A point that lies behind what the view sees is hidden from it, and
nothing follows.
Promise: only reduced copies are read, so no file is opened again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from splatseed.depth.settings import Settings
from splatseed.depth.views import Reduced
from splatseed.kernels.jit import inline
from splatseed.views.projection import place

THROUGH = 2.0
"""Clearly farther: by this many tolerances, as both depths have errors."""

ALWAYS = 8
"""Views asked about every point; more are asked about points that lack confirmation."""

SAYS_NOTHING, CONFIRMS, LOOKS_THROUGH = range(3)


@dataclass(frozen=True, eq=False)
class Support:
    """The verdict of other views on a view's candidates.

    Args:
        agreeing: How many confirm each, counted up to the number required, uint8 [C].
        seen_through: Whether some view looks through each, bool [C].
    """

    agreeing: UInt8[np.ndarray, " C"]
    seen_through: Bool[np.ndarray, " C"]


def find_support(
    xyz: Float32[np.ndarray, "C 3"], own: Reduced, others: Sequence[Reduced], settings: Settings
) -> Support:
    """Compare candidates with other views.

    Args:
        xyz: The candidates of one view, in the world.
        own: That view's reduced copy.
        others: The reduced copies of the views to ask.
        settings: How many must confirm, and the tolerances.
    """
    agreeing = np.zeros(len(xyz), np.uint8)
    seen_through = np.zeros(len(xyz), np.bool_)
    # The sum over three channels of 8 bits.
    limit = np.inf if settings.color_tolerance is None else 3 * 255 * settings.color_tolerance
    rgb = np.empty((len(xyz), 3), np.uint8)
    _own_colors(xyz, own.grid_from_world, own.rgb, own.rgb_from_grid, rgb)
    for rank, other in enumerate(others):
        _ask(
            xyz,
            rgb,
            other.z,
            other.factor,
            other.grid_from_world,
            other.rgb,
            other.rgb_from_grid,
            settings.tolerance,
            limit,
            settings.min_agreeing,
            rank >= ALWAYS,
            agreeing,
            seen_through,
        )
    return Support(agreeing, seen_through)


@inline
def _own_colors(xyz, grid_from_world, rgb, rgb_from_grid, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Colours of a view's own reduced photograph at its candidates, as smooth as the others'."""
    for k in range(len(xyz)):
        column, row, _ = place(xyz[k], grid_from_world)
        p, q = _block(column, row, rgb_from_grid, rgb.shape)
        for channel in range(3):
            out[k, channel] = rgb[p, q, channel]


@inline
def _ask(  # type: ignore[no-untyped-def]  # Numba's types
    xyz,
    own,
    z,
    factor,
    grid_from_world,
    rgb,
    rgb_from_grid,
    tolerance,
    limit,
    enough,
    only_unconfirmed,
    agreeing,
    seen_through,
):
    """Add one neighbour's verdict on all candidates."""
    height, width = z.shape
    for k in range(len(xyz)):
        if only_unconfirmed and agreeing[k] >= enough:
            continue
        column, row, depth = place(xyz[k], grid_from_world)
        if depth > 0.0 and -0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5:
            # In the map's own units: one division here instead of four multiplications.
            verdict = _compare(z, column, row, depth / factor, tolerance)
            if verdict == LOOKS_THROUGH:
                seen_through[k] = True
            elif verdict == CONFIRMS and agreeing[k] < enough:
                p, q = _block(column, row, rgb_from_grid, rgb.shape)
                agreeing[k] += _color_error(own[k], rgb[p, q]) <= limit


@inline
def _compare(z, column, row, depth, tolerance):  # type: ignore[no-untyped-def]  # Numba's types
    """What the map of a view says about a depth at a grid position; NaN says nothing."""
    x0 = min(max(int(np.floor(column)), 0), max(z.shape[1] - 2, 0))
    y0 = min(max(int(np.floor(row)), 0), max(z.shape[0] - 2, 0))
    x1, y1 = min(x0 + 1, z.shape[1] - 1), min(y0 + 1, z.shape[0] - 1)
    a, b, c, d = z[y0, x0], z[y0, x1], z[y1, x0], z[y1, x1]
    # One agreeing corner confirms; all four must be farther to look through. NaN does neither.
    near = tolerance * depth
    if (
        abs(a - depth) <= near
        or abs(b - depth) <= near
        or abs(c - depth) <= near
        or abs(d - depth) <= near
    ):
        return CONFIRMS
    far = depth + THROUGH * near
    if a > far and b > far and c > far and d > far:
        return LOOKS_THROUGH
    return SAYS_NOTHING


@inline
def _block(column, row, rgb_from_grid, shape):  # type: ignore[no-untyped-def]  # Numba's types
    """Row and column of the reduced photograph at a grid position."""
    p = int(np.floor(row * rgb_from_grid[1, 0] + rgb_from_grid[1, 1]))
    q = int(np.floor(column * rgb_from_grid[0, 0] + rgb_from_grid[0, 1]))
    return min(max(p, 0), shape[0] - 1), min(max(q, 0), shape[1] - 1)


@inline
def _color_error(first, second):  # type: ignore[no-untyped-def]  # Numba's types
    """Sum of the channels' differences."""
    total = np.int64(0)
    for channel in range(3):
        total += abs(np.int64(first[channel]) - np.int64(second[channel]))
    return total
