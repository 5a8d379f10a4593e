"""Which depths other views confirm.

Notation: view i has planes [3, h, w] on its grid; point X at one of its grid points falls on the
grid of view j at (column, row), where j's own plane at the nearest grid point says inverse depth
w_j. Both *agree* if |z_ij w_j - 1| <= tolerance, z_ij the depth of X in j. Promise: only maps and
cameras are read; every pair is compared in one direction at a time, so the order of views is
irrelevant.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

from splatseed.kernels.jit import inline


@inline
def confirm(
    planes, costs, max_cost, grid, j_from_i, other_planes, other_costs, tolerance, bit, out
):
    """Set a bit where another view's map agrees with a view's.

    Args:
        planes: The view's planes, float32 [3, h, w].
        costs: The view's costs, float32 [h, w].
        max_cost: Planes of higher cost neither ask nor answer.
        grid: Pixels between grid points.
        j_from_i: Maps pixels of the view times depth, and 1, to the other's times its depth; [3,
            4].
        other_planes: The other view's planes, float32 [3, p, q].
        other_costs: The other view's costs, float32 [p, q].
        tolerance: Relative difference of depth.
        bit: The bit to set, uint8.
        out: The bits of each grid point, uint8 [h, w].
    """
    height, width = costs.shape
    m = j_from_i
    for row in range(height):
        for column in range(width):
            if costs[row, column] > max_cost:
                continue
            # X at depth z on the pixel's ray, and its depth and pixel in the other view.
            z = 1.0 / planes[0, row, column]
            u, v = (column + 0.5) * grid * z, (row + 0.5) * grid * z
            depth = m[2, 0] * u + m[2, 1] * v + m[2, 2] * z + m[2, 3]
            if not depth > 0.0:
                continue
            x = (m[0, 0] * u + m[0, 1] * v + m[0, 2] * z + m[0, 3]) / depth
            y = (m[1, 0] * u + m[1, 1] * v + m[1, 2] * z + m[1, 3]) / depth
            if _agrees(x, y, depth, grid, other_planes, other_costs, max_cost, tolerance):
                out[row, column] |= bit


@inline
def _agrees(x, y, depth, grid, planes, costs, max_cost, tolerance):
    """Whether a map has this depth at pixel (x, y)."""
    rows, columns = costs.shape
    if not (0.0 <= x < columns * grid and 0.0 <= y < rows * grid):
        return False
    # The nearest grid point: (p, q) lies at pixel ((q + 0.5) g, (p + 0.5) g).
    q, p = int(x / grid), int(y / grid)
    if costs[p, q] > max_cost:
        return False
    # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
    across, down = x - (q + 0.5) * grid, y - (p + 0.5) * grid
    w = planes[0, p, q] + planes[1, p, q] * across + planes[2, p, q] * down
    # |z_ij w_j - 1|: a relative difference of depth, with one multiplication.
    return abs(depth * w - 1.0) <= tolerance
