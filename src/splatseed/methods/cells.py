"""Voronoi cells: the default's, from neighbours alone, and the paper's, in a bounding box.

*Meshless.* Each cell alone, in parallel (N. Ray, D. Sokolov, S. Lefebvre, B. Levy, Meshless Voronoi
on the GPU, 2018): it starts as a cube with its half-side at half the distance of the k-th
neighbour, and is cut by the bisector with each neighbour, nearest first, until the next neighbour
is more than twice as far as the cell's farthest vertex (the security radius), when no further one
can cut it. Coordinates are relative to the site. A plane f is {x : normal_f . x = offset_f}, planes
0-5 being the cube's. A vertex is the meeting of three planes, kept as an oriented triple (a, b, c);
``twin[a, b]`` is the vertex whose triple runs through a then b, so that the other end of its edge
is ``twin[b, a]``. Promise: a cut only ever moves along edges, so vertices stay inside the cube.

*Box.* SciPy's Voronoi cells, for reproducing the paper only. The eight corners of the bounding box,
enlarged by 10%, are added as sites so that the cells of the originals are bounded. The volume of a
cell is equation 6's, vol_i = E[|v - c_i|]^3 over its vertices v and their mean c_i. Most of it then
lies in the cells of a few outer points and reaches far outside the scene (``docs/paper.md``).
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int32
from scipy.spatial import QhullError, Voronoi

from splatseed.errors import PointCloudError
from splatseed.methods.neighbors import PreparedCloud
from splatseed.progress import Progress
from splatseed.runtime.jit import inline, kernel, parallel_range

MAX_NEIGHBORS = 58  # so that planes, with the cube's 6, are 64
MAX_PLANES = 6 + MAX_NEIGHBORS
MAX_VERTICES = 2 * MAX_PLANES  # 2 F - 4 on a simple polytope of F faces
COINCIDENT = 1e-12
"""Cuts shallower than this fraction of the cube are skipped: they only make slivers."""


class Cells(NamedTuple):
    """Cells of n sites, all relative to the site.

    ``center``, their mean, and ``radius``, the largest distance from it, are of vertices clamped to
    the clamping distance; ``closed`` tells true Voronoi cells: no face of the cube is left, and the
    security radius was passed.
    """

    center: Float64[np.ndarray, "n 3"]
    radius: Float64[np.ndarray, " n"]
    volume: Float64[np.ndarray, " n"]  # within the cube
    closed: Bool[np.ndarray, " n"]


def build_cells(
    xyz: Float64[np.ndarray, "n 3"],
    idx: Int32[np.ndarray, "n k"],
    distance: Float64[np.ndarray, "n k"],
    frames: Float64[np.ndarray, "n 3 3"],
    first: int,
    last: int,
    cells: Cells,
) -> None:
    """Fill rows ``first:last`` of ``cells``.

    ``frames`` are the axes of each cube, ``idx`` and ``distance`` its neighbours, nearest first,
    ``MAX_NEIGHBORS`` at most.
    """
    _build(xyz, idx, distance, frames, first, last, *cells)


@kernel
def _build(xyz, idx, distance, frames, first, last, center, radius, volume, closed):  # type: ignore[no-untyped-def]  # Numba's types
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
def _cube(frame, reach, normal, offset, triple, vertex, twin):  # type: ignore[no-untyped-def]  # Numba's types
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
def _set(triple, twin, v, a, b, c):  # type: ignore[no-untyped-def]  # Numba's types
    triple[v, 0], triple[v, 1], triple[v, 2] = a, b, c
    twin[a, b], twin[b, c], twin[c, a] = v, v, v


@inline
def _cut_all(xyz, i, rows, distance, normal, offset, triple, vertex, twin, count):  # type: ignore[no-untyped-def]  # Numba's types
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
        tolerance = COINCIDENT * distance[-1]
        if _measure(normal[plane], offset[plane], vertex, count, signed) > tolerance:
            count = _cut(plane, triple, vertex, twin, count, signed, fresh, place)
            farthest = _farthest_squared(vertex, count)
    return count, 0.25 * distance[-1] * distance[-1] > farthest


@inline
def _farthest_squared(vertex, count):  # type: ignore[no-untyped-def]  # Numba's types
    farthest = 0.0
    for v in range(count):
        farthest = max(farthest, vertex[v, 0] ** 2 + vertex[v, 1] ** 2 + vertex[v, 2] ** 2)
    return farthest


@inline
def _measure(normal, offset, vertex, count, signed):  # type: ignore[no-untyped-def]  # Numba's types
    """Signed distances of the vertices beyond a plane; returns the largest."""
    largest = -np.inf
    for v in range(count):
        signed[v] = (
            normal[0] * vertex[v, 0] + normal[1] * vertex[v, 1] + normal[2] * vertex[v, 2] - offset
        )
        largest = max(largest, signed[v])
    return largest


@inline
def _cut(plane, triple, vertex, twin, count, signed, fresh, place):  # type: ignore[no-untyped-def]  # Numba's types
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
def _move(target, to, source, at):  # type: ignore[no-untyped-def]  # Numba's types
    # One by one: assigning a row to a row takes longer to compile.
    for axis in range(3):
        target[to, axis] = source[at, axis]


@inline
def _drop_removed(triple, vertex, twin, count, signed):  # type: ignore[no-untyped-def]  # Numba's types
    """Move the kept vertices to the front."""
    kept = 0
    for v in range(count):
        if signed[v] <= 0.0:
            if kept < v:
                _set(triple, twin, kept, triple[v, 0], triple[v, 1], triple[v, 2])
                _move(vertex, kept, vertex, v)
            kept += 1


@inline
def _touches_cube(triple, count):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether a face of the cube is left."""
    for v in range(count):
        for side in range(3):
            if triple[v, side] < 6:
                return True
    return False


@inline
def _volume(normal, offset, triple, vertex, twin, count):  # type: ignore[no-untyped-def]  # Numba's types
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
def _clamp(vertex, count, reach, center):  # type: ignore[no-untyped-def]  # Numba's types
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


ENLARGE = 0.1  # the paper's 10%


def box_cells(
    cloud: PreparedCloud, progress: Progress
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Centre relative to the site, radius and volume (equation 6) of each original's cell.

    The centre c_i is the mean of the vertices, the radius the largest distance of one from it.

    Raises:
        PointCloudError: Qhull fails, as it can on coplanar input.
    """
    progress("voronoi", 0.0)
    try:
        diagram = Voronoi(np.concatenate([cloud.xyz, _corners(cloud.xyz)]))
    except QhullError as error:
        raise PointCloudError(
            "a cloud that Qhull can build a Voronoi diagram of",
            found=str(error).splitlines()[0],
            fix='Use the default profile (voronoi.cells "clamped"), which has no such limit.',
        ) from error
    progress("voronoi", 0.6)
    n = len(cloud)
    # A site that Qhull merges with another has no region (-1).
    regions = [
        diagram.regions[region] if region >= 0 else [] for region in diagram.point_region[:n]
    ]
    site = np.repeat(np.arange(n), [len(region) for region in regions])
    vertex = np.fromiter(itertools.chain.from_iterable(regions), np.int64, len(site))
    site, vertex = site[vertex >= 0], vertex[vertex >= 0]  # -1: the one at infinity
    xyz = diagram.vertices[vertex] - cloud.xyz[site]
    count = np.maximum(np.bincount(site, minlength=n), 1)
    center = np.stack([np.bincount(site, axis, n) for axis in xyz.T], axis=1) / count[:, None]
    distance = np.linalg.norm(xyz - center[site], axis=1)
    radius = np.zeros(n)
    np.maximum.at(radius, site, distance)
    progress("voronoi", 1.0)
    return center, radius, (np.bincount(site, distance, n) / count) ** 3


def _corners(xyz: np.ndarray) -> np.ndarray:
    """Corners [8, 3] of the bounding box enlarged by 10% about its middle."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    # A flat cloud gets a box of some thickness, or the corners would coincide.
    half = np.maximum((high - low) / 2, 1e-3 * (high - low).max()) * (1 + ENLARGE)
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    return np.asarray((low + high) / 2 + signs * half)
