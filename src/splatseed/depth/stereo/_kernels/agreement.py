"""Comparisons of depth between views: which depths others confirm, and one seed a cell.

Notation: as in ``matching``. ``j_from_i`` [3, 4], from ``other_from_view``, maps homogeneous pixels
of view i times depth, and 1, to those of view j. Promise: each call writes one view's arrays only,
in a fixed order.
"""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import always_inline, inline


@inline
def confirm(
    planes, costs, max_cost, grid, j_from_i, other_planes, other_costs, tolerance, bit, out
):
    """Set a bit at the pixels of view i whose depth the map of view j confirms.

    Args:
        planes: Of view i, float32 [3, h, w].
        costs: Of view i, float32 [h, w].
        max_cost: Pixels above it, of either view, are skipped.
        grid: Pixels between grid points.
        j_from_i: float64 [3, 4].
        other_planes: Of view j, float32 [3, h', w'].
        other_costs: Of view j, float32 [h', w'].
        tolerance: Relative difference of depth.
        bit: The bit to set, uint8.
        out: uint8 [h, w], updated in place.
    """
    height, width = costs.shape
    m = j_from_i
    for row in range(height):
        for column in range(width):
            if costs[row, column] > max_cost:
                continue
            # X at depth z on the pixel's ray, and its depth and pixel in view j.
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
    # |z_ij w_j - 1|: the relative difference of depth, without a division.
    return abs(depth * w - 1.0) <= tolerance


@inline
def occupy_cells(
    order, levels, planes, agreeing, own, others, matrices, grid, split, limits, cells, same,
    occupied, offsets, columns, out,
):  # fmt: skip
    """Choose places in a view greedily: one per cell of every view that sees it at that depth.

    Each pixel of a map has split x split places, on its plane. Each view is divided into cells of
    several sizes, the *levels*. A place needs a free cell at its pixel's level, and occupies its
    cells at all levels.

    Args:
        order: Pixels of the view, row * w + column, by priority, [P].
        levels: Of each pixel of the view, uint8 [h, w].
        planes: Of the view, float32 [3, h, w].
        agreeing: Bit k is set where view ``others[k]`` confirms the depth, uint8 [h, w].
        own: Number of the view.
        others: Numbers of the views it was compared with, int64 [K].
        matrices: ``j_from_i`` of these views, float64 [K, 3, 4].
        grid: Pixels between grid points.
        split: Places along a row and a column of a pixel of the map.
        limits: Width and height of each view, [V, 2].
        cells: Side of a cell at each level in pixels, float64 [L].
        same: Relative difference of depth up to which a cell counts as occupied.
        occupied: Inverse depth of the seed in each cell of all views, 0 where there is none,
            float32 [C], updated in place.
        offsets: Start of each view's cells at each level, int64 [V, L].
        columns: Cells in a row, likewise, int64 [V, L].
        out: Whether each place of each pixel of ``order`` is chosen, bool [P, split * split].
    """
    width = agreeing.shape[1]
    num = len(others)
    views, inverses = np.zeros(num + 1, np.int64), np.zeros(num + 1, np.float32)
    x, y = np.zeros(num + 1), np.zeros(num + 1)
    views[0] = own
    for n in range(len(order)):
        row, column = order[n] // width, order[n] % width
        level = levels[row, column]
        for place in range(split * split):
            # w(u, v) = w0 + gx (u - u0) + gy (v - v0)
            across = ((place % split + 0.5) / split - 0.5) * grid
            down = ((place // split + 0.5) / split - 0.5) * grid
            w = planes[0, row, column] + planes[1, row, column] * across
            w += planes[2, row, column] * down
            u, v = (column + 0.5) * grid + across, (row + 0.5) * grid + down
            x[0], y[0], inverses[0] = u, v, w
            count = 1
            for k in range(num):
                # Its cell in each view that confirms it: a surface must not get a seed per view.
                if agreeing[row, column] >> np.uint8(k) & 1:
                    m, j, z = matrices[k], others[k], 1.0 / w
                    depth = (m[2, 0] * u + m[2, 1] * v + m[2, 2]) * z + m[2, 3]
                    px = ((m[0, 0] * u + m[0, 1] * v + m[0, 2]) * z + m[0, 3]) / depth
                    py = ((m[1, 0] * u + m[1, 1] * v + m[1, 2]) * z + m[1, 3]) / depth
                    # The pixel's centre lies in that view; other places may lie outside.
                    if 0.0 <= px < limits[j, 0] and 0.0 <= py < limits[j, 1]:
                        views[count], x[count], y[count] = j, px, py
                        inverses[count] = 1.0 / depth
                        count += 1
            free = w > 0.0
            for k in range(count):
                cell = _cell(views[k], level, x[k], y[k], cells, offsets, columns)
                # 0 marks a free cell, as 0 / w is far from 1.
                free = free and not abs(occupied[cell] / inverses[k] - 1.0) <= same
            if free:
                out[n, place] = True
                for k in range(count):
                    for each in range(len(cells)):
                        cell = _cell(views[k], each, x[k], y[k], cells, offsets, columns)
                        occupied[cell] = inverses[k]


@always_inline
def _cell(view, level, x, y, cells, offsets, columns):
    """Index of the cell of a view that holds a pixel, at one level."""
    side = cells[level]
    return offsets[view, level] + int(y / side) * columns[view, level] + int(x / side)
