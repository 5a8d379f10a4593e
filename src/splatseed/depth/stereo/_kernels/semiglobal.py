"""Costs of fronto-parallel planes, and their aggregation along paths.

Notation: a view has H x W pixels and D hypotheses of inverse depth w_0 < ... < w_(D-1).
``j_from_i`` [3, 4], from ``matching.other_from_view``, maps homogeneous pixels of the view times
depth, and 1, to those of another view. The cost of a pixel is one minus the correlation of the
square windows around it, of at most 1. Path costs, along each direction r,

    L(p, d) = C(p, d) + min(L(q, d), L(q, d - 1) + P1, L(q, d + 1) + P1, min_k L(q, k) + P2)
              - min_k L(q, k),    q = p - r,

where P2 falls with the contrast between p and q: depth changes where grey levels do. Source:
H. Hirschmueller, Stereo Processing by Semiglobal Matching and Mutual Information (2008).
Promise: each call writes one view's arrays only, in a fixed order.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import inline

OUTSIDE, IN_FRONT, SEEN, BEHIND = 0, 1, 2, 3
"""Where a point lies: outside the other frame or behind the camera, in front of the surface that
the other view's map has there, at it (or there is no map yet), behind it."""


@inline
def place(j_from_i, w, grey, depths, tolerance, sampled, places):
    """Sample the other view's photograph on the plane at inverse depth w, and say where it lies.

    Args:
        j_from_i: float64 [3, 4].
        w: Inverse depth in the view, float32.
        grey: The other photograph, float32 [h, w].
        depths: The other view's map, float32 [h, w]; empty if there is none.
        tolerance: Relative difference of depth within which a point is at the surface.
        sampled: Grey levels, float32 [H, W]; outside the frame those of its border.
        places: uint8 [H, W].
    """
    m = j_from_i
    height, width = grey.shape
    has_map = depths.size > 0
    nearer, farther = 1.0 - tolerance, 1.0 + tolerance
    for row in range(sampled.shape[0]):
        # Times w, the point is m (u, v, 1, w): linear along the row.
        v = row + 0.5
        x0 = m[0, 1] * v + m[0, 2] + m[0, 3] * w
        y0 = m[1, 1] * v + m[1, 2] + m[1, 3] * w
        z0 = m[2, 1] * v + m[2, 2] + m[2, 3] * w
        for column in range(sampled.shape[1]):
            u = column + 0.5
            z = z0 + m[2, 0] * u
            if not z > 0.0:
                sampled[row, column], places[row, column] = 0.0, OUTSIDE
                continue
            per_z = 1.0 / z
            x, y = (x0 + m[0, 0] * u) * per_z, (y0 + m[1, 0] * u) * per_z
            inside = 0.0 <= x < width and 0.0 <= y < height
            where = SEEN if inside else OUTSIDE
            if inside and has_map:
                # Its depth there is z / w.
                surface = depths[int(y), int(x)] * w
                if z < surface * nearer:
                    where = IN_FRONT
                elif z > surface * farther:
                    where = BEHIND
            x, y = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
            p, q = min(int(y), height - 2), min(int(x), width - 2)
            down, across = np.float32(y - p), np.float32(x - q)
            above = grey[p, q] + across * (grey[p, q + 1] - grey[p, q])
            below = grey[p + 1, q] + across * (grey[p + 1, q + 1] - grey[p + 1, q])
            sampled[row, column] = above + down * (below - above)
            places[row, column] = where


@inline
def correlate(grey, sampled, radius, noise, sums, out):
    """Write one minus the correlation of the windows around each pixel, at most 1.

    Args:
        grey: The view's photograph, float32 [H, W].
        sampled: The other one, sampled at its pixels, float32 [H, W].
        radius: Windows have 2 radius + 1 pixels a side, fewer at the border.
        noise: Added to variances, squared grey levels: weaker texture does not correlate.
        sums: Scratch, float64 [5, W].
        out: float32 [H, W].
    """
    height, width = grey.shape
    sums[:] = 0.0
    for row in range(-radius, height):
        if row + radius < height:
            _add_row(grey[row + radius], sampled[row + radius], 1.0, sums)
        if row - radius - 1 >= 0:
            _add_row(grey[row - radius - 1], sampled[row - radius - 1], -1.0, sums)
        if row < 0:
            continue
        rows = min(row + radius, height - 1) - max(row - radius, 0) + 1
        a = b = aa = bb = ab = 0.0
        for column in range(-radius, width):
            k = column + radius
            if k < width:
                a, b = a + sums[0, k], b + sums[1, k]
                aa, bb, ab = aa + sums[2, k], bb + sums[3, k], ab + sums[4, k]
            k = column - radius - 1
            if k >= 0:
                a, b = a - sums[0, k], b - sums[1, k]
                aa, bb, ab = aa - sums[2, k], bb - sums[3, k], ab - sums[4, k]
            if column < 0:
                continue
            columns = min(column + radius, width - 1) - max(column - radius, 0) + 1
            n = 1.0 / (rows * columns)
            of_a, of_b = max(aa * n - a * a * n * n, 0.0), max(bb * n - b * b * n * n, 0.0)
            shared = ab * n - a * b * n * n
            correlation = shared / math.sqrt((of_a + noise) * (of_b + noise))
            out[row, column] = min(1.0 - correlation, 1.0)


@inline
def _add_row(a, b, sign, sums):
    for column in range(len(a)):
        x, y = np.float64(a[column]), np.float64(b[column])
        sums[0, column] += sign * x
        sums[1, column] += sign * y
        sums[2, column] += sign * x * x
        sums[3, column] += sign * y * y
        sums[4, column] += sign * x * y


@inline
def combine(costs, places, best_weight, unseen, in_front, out):
    """Combine the costs of a hypothesis in S other views: their smallest and their mean.

    Views that do not see the point say nothing. A point in front of the surface that another view
    sees costs ``in_front`` more there; one that no view sees costs ``unseen``.

    Args:
        costs: float32 [S, H, W].
        places: uint8 [S, H, W].
        best_weight: Weight of the smallest cost; the rest is the mean's.
        unseen: As above.
        in_front: As above.
        out: float32 [H, W].
    """
    count, height, width = costs.shape
    for row in range(height):
        for column in range(width):
            seen, total, best = 0, 0.0, np.inf
            for s in range(count):
                where = places[s, row, column]
                if where in (OUTSIDE, BEHIND):
                    continue
                cost = costs[s, row, column] + (in_front if where == IN_FRONT else 0.0)
                seen, total, best = seen + 1, total + cost, min(best, cost)
            if seen:
                out[row, column] = best_weight * best + (1.0 - best_weight) * total / seen
            else:
                out[row, column] = unseen


@inline
def aggregate(costs, grey, down, across, small, large, contrast, total):
    """Add the path costs of one direction to ``total``.

    Args:
        costs: float32 [H, W, D].
        grey: The view's photograph, float32 [H, W].
        down: Of the direction: rows from a pixel to the next, -1 to 1.
        across: Columns, -1 to 1.
        small: P1.
        large: P2 without contrast; it is at least 1.5 P1.
        contrast: Grey levels by which P2 falls to its e-th part.
        total: float32 [H, W, D], updated in place.
    """
    height, width, count = costs.shape
    # L and its minimum, of the row before and of this row.
    before, now = np.zeros((width, count), np.float32), np.zeros((width, count), np.float32)
    least_before, least_now = np.zeros(width, np.float32), np.zeros(width, np.float32)
    for i in range(height):
        row = i if down >= 0 else height - 1 - i
        for j in range(width):
            column = j if across >= 0 else width - 1 - j
            p, q = row - down, column - across
            least = np.float32(np.inf)
            if not (0 <= p < height and 0 <= q < width):
                for d in range(count):
                    value = costs[row, column, d]
                    now[column, d] = value
                    total[row, column, d] += value
                    least = min(least, value)
                least_now[column] = least
                continue
            difference = abs(grey[row, column] - grey[p, q])
            jump = np.float32(max(large * math.exp(-difference / contrast), 1.5 * small))
            path, base = (now[q], least_now[q]) if down == 0 else (before[q], least_before[q])
            highest = base + jump
            for d in range(count):
                value = path[d]
                if d > 0:
                    value = min(value, path[d - 1] + small)
                if d < count - 1:
                    value = min(value, path[d + 1] + small)
                value = costs[row, column, d] + min(value, highest) - base
                now[column, d] = value
                total[row, column, d] += value
                least = min(least, value)
            least_now[column] = least
        before, now = now, before
        least_before, least_now = least_now, least_before


@inline
def cheapest(total, hypotheses, out):
    """Write the depth of the smallest total cost, between hypotheses by a parabola.

    Args:
        total: float32 [H, W, D].
        hypotheses: Inverse depths, float32 [D].
        out: Depth, float32 [H, W].
    """
    height, width, count = total.shape
    for row in range(height):
        for column in range(width):
            best = 0
            for d in range(1, count):
                if total[row, column, d] < total[row, column, best]:
                    best = d
            offset = 0.0
            if 0 < best < count - 1:
                left, right = total[row, column, best - 1], total[row, column, best + 1]
                bend = left + right - 2.0 * total[row, column, best]
                if bend > 0.0:
                    offset = 0.5 * (left - right) / bend
            low = int(min(max(best + offset, 0.0), count - 2.0))
            part = best + offset - low
            w = hypotheses[low] * (1.0 - part) + hypotheses[low + 1] * part
            out[row, column] = 1.0 / w
