"""The paper's equations 1 to 9, typed as the text has them: slow, one point at a time, in NumPy.

Written from the equations alone, before reading the code. Two things come from elsewhere: SciPy's
smoothing spline for equation 3 and its Voronoi diagram for equation 6. Arrays are float64.

    xyz, rgb    the originals, [N, 3]; ``i`` is the row of the base point
    P           a new point, [3]
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy.interpolate import SmoothBivariateSpline
from scipy.spatial import Voronoi


def nearest(xyz, i, k):
    """The k nearest neighbours of point i, nearest first, without i itself."""
    distances = [np.linalg.norm(xyz[j] - xyz[i]) if j != i else np.inf for j in range(len(xyz))]
    return np.argsort(distances)[:k]


# Equations 1 and 2: P = sum of weights times points, with linear's (a, 1 - a) or barycentric ones.


def linear(values, i, xyz, a):
    """Equation 1, for positions or colours: P = a P1 + (1 - a) P2, P2 the nearest neighbour."""
    (j,) = nearest(xyz, i, 1)
    return a * values[i] + (1.0 - a) * values[j]


def triangle(values, i, xyz, weights):
    """Equation 2: barycentric weights on the base point and its two nearest neighbours."""
    j, k = nearest(xyz, i, 2)
    w1, w2, w3 = weights
    return w1 * values[i] + w2 * values[j] + w3 * values[k]


# Equations 3 to 5: z = S(x, y) over the neighbourhood, in the world's axes.


def neighborhood(xyz, i, k):
    """The base point and its k nearest neighbours, [k + 1, 3]."""
    return np.concatenate([xyz[i : i + 1], xyz[nearest(xyz, i, k)]])


def spline(xyz, i, k=25, s=None):
    """Equation 3: the cubic B-spline surface with smoothing s = 0.1 k, as a function of x, y."""
    x, y, z = neighborhood(xyz, i, k).T
    surface = SmoothBivariateSpline(x, y, z, kx=3, ky=3, s=0.1 * k if s is None else s)
    return lambda x, y: float(surface.ev(x, y))


def mls(xyz, i, k=10):
    """Equations 4 and 5: the quadratic that minimises sum w (q(x, y) - z)^2, w = 1 / distance.

    The base point's own weight would be infinite; it counts as at half its nearest neighbour's
    distance.
    """
    points = neighborhood(xyz, i, k)
    distances = [np.linalg.norm(p - points[0]) for p in points]
    distances[0] = 0.5 * min(distances[1:])
    rows, heights = [], []
    for (x, y, z), distance in zip(points - points[0], distances, strict=True):
        root = np.sqrt(1.0 / distance)
        rows.append([root * term for term in (1.0, x, y, x * x, x * y, y * y)])
        heights.append(root * z)
    q = np.linalg.lstsq(np.array(rows), np.array(heights), rcond=None)[0]

    def surface(x, y):
        x, y = x - points[0, 0], y - points[0, 1]
        return points[0, 2] + q @ [1.0, x, y, x * x, x * y, y * y]

    return surface


def mixed(rgb, xyz, rows, point):
    """The colour of a new point: that of some originals, weighted by 1 / distance."""
    weights = [1.0 / np.linalg.norm(point - xyz[j]) for j in rows]
    return sum(w * rgb[j] for w, j in zip(weights, rows, strict=True)) / sum(weights)


# Equation 6: Voronoi cells in the box that is enlarged by 10%.


def voronoi(xyz):
    """c [N, 3], r [N] and vol [N] of every original's cell; the box's corners bound the cells.

    c is the mean of a cell's vertices v, r = max |v - c|, and vol = (mean |v - c|)^3. The box's
    edges are 10% longer than those around the points, 5% at each end.
    """
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    margin = 0.05 * (high - low)
    ends = np.transpose([low - margin, high + margin])
    diagram = Voronoi(np.concatenate([xyz, list(itertools.product(*ends))]))
    c, r, vol = np.empty_like(xyz), np.empty(len(xyz)), np.empty(len(xyz))
    for i in range(len(xyz)):
        region = diagram.regions[diagram.point_region[i]]
        assert -1 not in region, "inside the corners' hull every cell is bounded"
        vertices = diagram.vertices[region]
        c[i] = vertices.mean(axis=0)
        distances = [np.linalg.norm(v - c[i]) for v in vertices]
        r[i] = max(distances)
        vol[i] = np.mean(distances) ** 3
    return c, r, vol


def voronoi_points(xyz, count, rng):
    """Cells drawn by their share of vol, then a point uniform in the ball (c, 0.5 r)."""
    c, r, vol = voronoi(xyz)
    points = []
    for i in rng.choice(len(xyz), count, p=vol / vol.sum()):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        points.append(c[i] + 0.5 * r[i] * rng.uniform() ** (1.0 / 3.0) * direction)
    return np.array(points)


# Equations 7 to 9: pixels lifted by their depth.


def unit_ray(camera, u, v):
    """The unit vector in the world through the image position (u, v)."""
    x = (u - camera.K[0, 2]) / camera.K[0, 0]
    y = (v - camera.K[1, 2]) / camera.K[1, 1]
    ray = camera.cam_from_world[:3, :3].T @ np.array([x, y, 1.0])
    return ray / np.linalg.norm(ray)


def camera_center(camera):
    """c: where the camera stands in the world."""
    return -camera.cam_from_world[:3, :3].T @ camera.cam_from_world[:3, 3]


def depth_scale(depth, camera, seen):
    """Equation 7: the s that minimises sum |s p_raw - (p_sfm - c)|^2, p_raw = d v as in equation 9.

    ``depth`` [H, W]; ``seen`` [M, 3] are the SfM points that the image saw. Each is compared with
    p_raw of the pixel on which it falls.
    """
    above = below = 0.0
    for point in seen:
        x, y, z = camera.cam_from_world[:3, :3] @ point + camera.cam_from_world[:3, 3]
        u = camera.K[0, 0] * x / z + camera.K[0, 2]
        v = camera.K[1, 1] * y / z + camera.K[1, 2]
        column, row = int(u), int(v)
        p_raw = depth[row, column] * unit_ray(camera, column + 0.5, row + 0.5)
        above += p_raw @ (point - camera_center(camera))
        below += p_raw @ p_raw
    return above / below


def lifted(depth, camera, scale, column, row):
    """Equation 9: P = c + s d v, v the unit vector through the pixel's centre."""
    v = unit_ray(camera, column + 0.5, row + 0.5)
    return camera_center(camera) + scale * depth[row, column] * v
