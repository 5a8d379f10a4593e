"""Slow Voronoi upsampling as it is by default: one cell at a time, by SciPy's Qhull.

Notation: as in ``references``. A cell is (centre, radius, volume), the centre being the mean of its
vertices and the radius the largest distance of one from there.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, Voronoi

from .references import base_weights, color_at, draw_bases, frame_at, neighbors


def clamped_cell(xyz, i, k):
    """A cube of half-side d_k / 2 cut by the bisectors, its vertices drawn in to d_k / 2."""
    rows, distance = neighbors(xyz, i, k)
    reach = 0.5 * distance[-1]
    frame = frame_at(xyz, i, rows)
    cube = [[*(sign * axis), -reach] for axis in frame for sign in (1, -1)]
    cuts = [[*(xyz[j] - xyz[i]) / d, -0.5 * d] for j, d in zip(rows, distance, strict=True)]
    vertices = HalfspaceIntersection(np.array(cube + cuts), np.zeros(3)).intersections
    volume = ConvexHull(vertices).volume
    length = np.linalg.norm(vertices, axis=1, keepdims=True)
    clamped = vertices * np.minimum(1.0, reach / length)
    center, radius = _center_and_radius(clamped)
    return xyz[i] + center, radius, volume


def true_cells(sites):
    """SciPy's Voronoi cell of every site, None where it is unbounded."""
    diagram = Voronoi(sites)
    regions = [diagram.regions[r] for r in diagram.point_region]
    return [None if -1 in r else _cell(diagram.vertices[r]) for r in regions]


def voronoi(cloud, num_new, rng, *, k=25):
    """A cell by its relative volume, then uniform in the ball of half its radius."""
    xyz = cloud.xyz
    cells = [clamped_cell(xyz, i, k) for i in range(len(xyz))]
    volume = np.array([cell[2] for cell in cells])
    bases = draw_bases(base_weights(xyz, k) * _relative(xyz, volume, k), num_new, rng)
    draws = rng.random((num_new, 3), dtype=np.float32).astype(np.float64)
    new_xyz, new_rgb = [], []
    for i, (d0, d1, d2) in zip(bases, draws, strict=True):
        rows, _ = neighbors(xyz, i, k)
        n, angle = 2 * d1 - 1, 2 * np.pi * d2
        ring = np.sqrt(1 - n * n)
        direction = np.array([ring * np.cos(angle), ring * np.sin(angle), n])
        center, radius, _ = cells[i]
        p = center + 0.5 * radius * np.cbrt(d0) * direction @ frame_at(xyz, i, rows)
        new_xyz.append(p)
        new_rgb.append(color_at(cloud, i, rows[:5], p))
    return np.array(new_xyz), np.array(new_rgb)


def _relative(xyz, volume, k):
    """Each volume over the median of its neighbours', at most 8."""
    return np.array(
        [min(v / np.median(volume[neighbors(xyz, i, k)[0]]), 8.0) for i, v in enumerate(volume)]
    )


def _cell(vertices):
    return *_center_and_radius(vertices), ConvexHull(vertices).volume


def _center_and_radius(vertices):
    center = vertices.mean(axis=0)
    return center, np.linalg.norm(vertices - center, axis=1).max()
