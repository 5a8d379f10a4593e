"""Meshless Voronoi cells, and points in their balls (paper, eq. 6).

Coordinates are relative to the site. A plane f is {x : normal_f . x = offset_f}; planes 0-5 are the
faces of the cube that a cell starts as. A vertex is the meeting of three planes, kept as an
oriented triple (a, b, c); ``twin[a, b]`` is the vertex whose triple runs through a then b, so that
the other end of its edge is ``twin[b, a]``. Promise: a cut only moves vertices along edges, so they
stay inside the cube. Source: N. Ray, D. Sokolov, S. Lefebvre, B. Levy, Meshless Voronoi on the GPU,
2018.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import inline, kernel, parallel_range

MAX_NEIGHBORS = 58
"""With the cube's 6 planes these make 64."""
MAX_PLANES = 6 + MAX_NEIGHBORS
MAX_VERTICES = 2 * MAX_PLANES
"""A simple polytope of F faces has 2 F - 4 vertices."""
MIN_CUT = 1e-12
"""Shallower cuts, as a fraction of the cube, are skipped: they only make slivers."""


@kernel
def build_cells(xyz, idx, distance, frames, first, last, center, radius, volume, closed):
    """Fill centre, radius, volume and ``closed`` of the cells of rows ``first:last``.

    A cell starts as a cube, whose axes are ``frames`` and whose half-side is half the distance of
    the k-th neighbour. The bisector with each neighbour cuts it, nearest first, until the next
    neighbour is more than twice as far as the cell's farthest vertex (the security radius): no
    further one can cut it.

    Args:
        xyz: Sites [n, 3].
        idx: Neighbours of each site, nearest first, [n, k], k <= ``MAX_NEIGHBORS``.
        distance: Their distances [n, k].
        frames: Axes of each cube [n, 3, 3].
        first: First row to fill.
        last: Row after the last.
        center: Mean of the vertices, clamped to the half-side, relative to the site.
        radius: Largest distance of a clamped vertex from the centre.
        volume: Volume within the cube.
        closed: Whether no face of the cube is left and the security radius was reached.
    """
    for i in parallel_range(first, last):
        normal, offset = np.empty((MAX_PLANES, 3)), np.empty(MAX_PLANES)
        triple, vertex = np.empty((MAX_VERTICES, 3), np.int16), np.empty((MAX_VERTICES, 3))
        twin = np.empty((MAX_PLANES, MAX_PLANES), np.int16)  # entries are set before they are read
        reach = 0.5 * distance[i, -1]
        count = _cube(frames[i], reach, normal, offset, triple, vertex, twin)
        count, complete = _cut_all(
            xyz, i, idx[i], distance[i], normal, offset, triple, vertex, twin, count
        )
        closed[i] = complete and not _touches_cube(triple, count)
        volume[i] = _volume(normal, offset, triple, vertex, twin, count)
        radius[i] = _clamp(vertex, count, reach, center[i])


@inline
def _cube(frame, reach, normal, offset, triple, vertex, twin):
    """Planes +u -u +v -v +n -n and the eight corners; returns the number of vertices."""
    for face in range(6):
        for axis in range(3):
            normal[face, axis] = frame[face // 2, axis] * (1.0 - 2.0 * (face % 2))
        offset[face] = reach
    for corner in range(8):
        a, b, c = corner & 1, 2 + (corner >> 1 & 1), 4 + (corner >> 2 & 1)
        if (a + b + c) % 2:  # a mirrored corner runs the other way round
            b, c = c, b
        for axis in range(3):
            vertex[corner, axis] = reach * (normal[a, axis] + normal[b, axis] + normal[c, axis])
        _set(triple, twin, corner, a, b, c)
    return 8


@inline
def _set(triple, twin, v, a, b, c):
    triple[v, 0], triple[v, 1], triple[v, 2] = a, b, c
    twin[a, b], twin[b, c], twin[c, a] = v, v, v


@inline
def _cut_all(xyz, i, rows, distance, normal, offset, triple, vertex, twin, count):
    """Cut by the bisectors; returns the number of vertices and whether the cell is complete."""
    signed = np.empty(MAX_VERTICES)
    fresh, place = np.empty((MAX_VERTICES, 2), np.int16), np.empty((MAX_VERTICES, 3))
    farthest = _farthest_squared(vertex, count)
    for j in range(rows.size):
        # The bisector lies at half the distance: beyond the farthest vertex it cuts nothing.
        if 0.25 * distance[j] * distance[j] > farthest:
            return count, True
        plane = 6 + j
        for axis in range(3):
            normal[plane, axis] = (xyz[rows[j], axis] - xyz[i, axis]) / distance[j]
        offset[plane] = 0.5 * distance[j]
        tolerance = MIN_CUT * distance[-1]
        if _measure(normal[plane], offset[plane], vertex, count, signed) > tolerance:
            count = _cut(plane, triple, vertex, twin, count, signed, fresh, place)
            farthest = _farthest_squared(vertex, count)
    return count, 0.25 * distance[-1] * distance[-1] > farthest


@inline
def _farthest_squared(vertex, count):
    farthest = 0.0
    for v in range(count):
        farthest = max(farthest, vertex[v, 0] ** 2 + vertex[v, 1] ** 2 + vertex[v, 2] ** 2)
    return farthest


@inline
def _measure(normal, offset, vertex, count, signed):
    """Signed distances of the vertices beyond a plane; returns the largest."""
    largest = -np.inf
    for v in range(count):
        signed[v] = (
            normal[0] * vertex[v, 0] + normal[1] * vertex[v, 1] + normal[2] * vertex[v, 2] - offset
        )
        largest = max(largest, signed[v])
    return largest


@inline
def _cut(plane, triple, vertex, twin, count, signed, fresh, place):
    """Replace the vertices beyond ``plane`` by those on it; returns the number of vertices.

    Every directed edge (a, b) from a removed vertex to a kept one gives the new vertex
    (a, b, plane). The new vertices bound a disc of r removed ones with f whole faces, so there are
    r + 2 - 2 f; when rounding on coincident planes says otherwise, the cut is left out.
    """
    removed = made = 0
    for v in range(count):
        if signed[v] > 0.0:
            removed += 1
            for side in range(3):
                a, b = triple[v, side], triple[v, (side + 1) % 3]
                w = twin[b, a]
                if signed[w] <= 0.0:
                    # Where the edge from a removed vertex to a kept one meets the plane.
                    t = signed[v] / (signed[v] - signed[w])
                    fresh[made, 0], fresh[made, 1] = a, b
                    for axis in range(3):
                        place[made, axis] = vertex[v, axis] + t * (
                            vertex[w, axis] - vertex[v, axis]
                        )
                    made += 1
    kept = count - removed
    if made < 3 or (removed - made) % 2 or kept + made > MAX_VERTICES:
        return count
    _drop_removed(triple, vertex, twin, count, signed)
    for m in range(made):
        _set(triple, twin, kept + m, fresh[m, 0], fresh[m, 1], plane)
        _move(vertex, kept + m, place, m)
    return kept + made


@inline
def _move(target, to, source, at):
    # One by one: assigning a row to a row takes longer to compile.
    for axis in range(3):
        target[to, axis] = source[at, axis]


@inline
def _drop_removed(triple, vertex, twin, count, signed):
    """Move the kept vertices to the front."""
    kept = 0
    for v in range(count):
        if signed[v] <= 0.0:
            if kept < v:
                _set(triple, twin, kept, triple[v, 0], triple[v, 1], triple[v, 2])
                _move(vertex, kept, vertex, v)
            kept += 1


@inline
def _touches_cube(triple, count):
    """Whether a face of the cube is left."""
    for v in range(count):
        for side in range(3):
            if triple[v, side] < 6:
                return True
    return False


@inline
def _volume(normal, offset, triple, vertex, twin, count):
    """Sum over faces a of offset_a area_a / 3, the areas from their directed edges."""
    total = 0.0
    for v in range(count):
        for side in range(3):
            a, b = triple[v, side], triple[v, (side + 1) % 3]
            w, n = vertex[twin[b, a]], normal[a]
            x = vertex[v, 1] * w[2] - vertex[v, 2] * w[1]
            y = vertex[v, 2] * w[0] - vertex[v, 0] * w[2]
            z = vertex[v, 0] * w[1] - vertex[v, 1] * w[0]
            total += offset[a] * (n[0] * x + n[1] * y + n[2] * z)
    return abs(total) / 6.0


@inline
def _clamp(vertex, count, reach, center):
    """Clamp vertices to ``reach``; fill their mean; return the largest distance from it."""
    center[0] = center[1] = center[2] = 0.0
    for v in range(count):
        length = math.sqrt(vertex[v, 0] ** 2 + vertex[v, 1] ** 2 + vertex[v, 2] ** 2)
        inward = min(1.0, reach / length)
        for axis in range(3):
            vertex[v, axis] *= inward
            center[axis] += vertex[v, axis] / count
    largest = 0.0
    for v in range(count):
        squared = 0.0
        for axis in range(3):
            squared += (vertex[v, axis] - center[axis]) ** 2
        largest = max(largest, squared)
    return math.sqrt(largest)


@kernel
def relative_volume(volume, idx, cap, relative):
    """Each volume relative to the median of its neighbours', at most ``cap``."""
    for i in parallel_range(len(relative)):
        around = np.sort(volume[idx[i]])
        median = 0.5 * (around[(around.size - 1) // 2] + around[around.size // 2])
        relative[i] = min(volume[i] / median, cap) if median > 0.0 else 1.0


@kernel
def sample_balls(xyz, site_center, center, radius, frames, start, count, out):
    """Uniform in each cell's ball, replacing the draws in ``out``; directions turn with frames."""
    for i in parallel_range(len(count)):
        for m in range(start[i], start[i] + count[i]):
            r = radius[i] * np.float64(out[m, 0]) ** (1.0 / 3.0)
            n = 2.0 * np.float64(out[m, 1]) - 1.0
            angle = 2.0 * math.pi * np.float64(out[m, 2])
            ring = math.sqrt(max(1.0 - n * n, 0.0))
            u, v = ring * math.cos(angle), ring * math.sin(angle)
            for axis in range(3):
                direction = u * frames[i, 0, axis] + v * frames[i, 1, axis] + n * frames[i, 2, axis]
                local = xyz[i, axis] + center[i, axis] + r * direction
                out[m, axis] = site_center[axis] + local
