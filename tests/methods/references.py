"""Slow versions of every method as splatseed has it by default: plain Python loops.

The paper's own are in ``paper_equations``.

Notation: ``xyz`` float64 [n, 3] are distinct finite originals in file order, ``i`` a base point,
``rows`` its neighbours, nearest first. A *surface* is a function S(u, v) fitted to the neighbours
in the base's frame, ``local`` [k + 1, 3] being their coordinates u, v, z with the base last, at 0.
Promise: a reference asks ``rng`` for the same numbers in the same order as the fast version (how
many points each base makes, then the uniform draws), so that the two agree point by point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline


class Cloud(NamedTuple):
    """Originals: xyz float64 [n, 3], rgb uint8 [n, 3]."""

    xyz: np.ndarray
    rgb: np.ndarray


Surface = Callable[[float, float], float]
Fit = Callable[[np.ndarray, np.ndarray], Surface]


class Patch(NamedTuple):
    """What a height-field method does: the fields of ``PatchMethod`` and the fit itself."""

    fit: Fit
    k: int
    frame: str = "local"
    placement: str = "disc"
    clamp: float | None = 0.25


def neighbors(xyz, i, k):
    """Rows [k] and distances [k] of the k nearest other points, by looking at all of them."""
    distance = np.linalg.norm(xyz - xyz[i], axis=1)
    rows = [j for j in np.argsort(distance) if j != i][:k]
    return rows, distance[rows]


def spacing(xyz, i):
    """h: mean distance to the 6 nearest."""
    return neighbors(xyz, i, 6)[1].mean()


def is_isolated(xyz, i, k):
    """Spacing above 3 times the lower quartile of the (at most 16) neighbours'."""
    rows, _ = neighbors(xyz, i, min(max(k, 8), 16))
    around = sorted(spacing(xyz, j) for j in rows)
    return spacing(xyz, i) > 3.0 * around[len(around) // 4]


def base_weights(xyz, k):
    """1 for points that may serve as bases, else 0, [n]."""
    return np.array([0.0 if is_isolated(xyz, i, k) else 1.0 for i in range(len(xyz))])


def draw_bases(weight, num_new, rng):
    """The base of every new point, in file order, [num_new]."""
    return np.repeat(np.arange(len(weight)), rng.multinomial(num_new, weight / weight.sum()))


def linear(cloud, num_new, rng):
    """Eq. 1: P = a P1 + (1 - a) P2; the same for colours."""
    weight = base_weights(cloud.xyz, 1)
    bases = draw_bases(weight, num_new, rng)
    alpha = rng.random(num_new, dtype=np.float32).astype(np.float64)
    new_xyz, new_rgb = [], []
    for i, a in zip(bases, alpha, strict=True):
        (j,), _ = neighbors(cloud.xyz, i, 1)
        new_xyz.append(a * cloud.xyz[i] + (1 - a) * cloud.xyz[j])
        new_rgb.append(np.floor(a * cloud.rgb[i] + (1 - a) * cloud.rgb[j] + 0.5))
    return np.array(new_xyz), np.array(new_rgb)


def triangle(cloud, num_new, rng):
    """Eq. 2: barycentric weights 1 - sqrt(s), sqrt(s) (1 - t), sqrt(s) t; the same for colours."""
    weight = base_weights(cloud.xyz, 2)
    bases = draw_bases(weight, num_new, rng)
    draws = rng.random((num_new, 2), dtype=np.float32).astype(np.float64)
    new_xyz, new_rgb = [], []
    for i, (s, t) in zip(bases, draws, strict=True):
        corners = [i, *neighbors(cloud.xyz, i, 2)[0]]
        b = np.array([1 - np.sqrt(s), np.sqrt(s) * (1 - t), np.sqrt(s) * t])
        new_xyz.append(b @ cloud.xyz[corners])
        new_rgb.append(np.floor(b @ cloud.rgb[corners] + 0.5))
    return np.array(new_xyz), np.array(new_rgb)


def frame_at(xyz, i, rows):
    """Rows e_u, e_v, e_n: principal axes, e_u and e_v towards their farthest neighbour."""
    _, vectors = np.linalg.eigh(np.cov(xyz[[i, *rows]].T))
    axes = []
    for axis in (vectors[:, 2], vectors[:, 1]):
        along = (xyz[rows] - xyz[i]) @ axis
        axes.append(axis * np.sign(along[np.argmax(np.abs(along))]))
    return np.array([*axes, np.cross(*axes)])


def color_at(cloud, i, rows, p):
    """Inverse-distance weights over the base and its neighbours, with a floor of 0.01 h."""
    floor = 0.01 * spacing(cloud.xyz, i)
    total, color = 0.0, np.zeros(3)
    for j in (i, *rows):
        weight = 1.0 / max(np.linalg.norm(p - cloud.xyz[j]), floor)
        total += weight
        color += weight * cloud.rgb[j]
    return np.floor(color / total + 0.5)


def on_patches(cloud, num_new, rng, patch):
    """New points on a surface fitted to the neighbours of every base."""
    weight = base_weights(cloud.xyz, patch.k)
    bases = draw_bases(weight, num_new, rng)
    columns = 3 if patch.placement == "triangle" else 2
    draws = rng.random((num_new, columns), dtype=np.float32).astype(np.float64)
    new_xyz, new_rgb = [], []
    for i, draw in zip(bases, draws, strict=True):
        rows, distance = neighbors(cloud.xyz, i, patch.k)
        frame = frame_at(cloud.xyz, i, rows) if patch.frame == "local" else np.eye(3)
        local = (cloud.xyz[[*rows, i]] - cloud.xyz[i]) @ frame.T
        u, v = PLACEMENTS[patch.placement](local, spacing(cloud.xyz, i), draw)
        z = patch.fit(local, distance)(u, v)
        if patch.clamp is not None:
            low, high = local[:, 2].min(), local[:, 2].max()
            slack = patch.clamp * (high - low)
            z = min(max(z, low - slack), high + slack)
        p = cloud.xyz[i] + np.array([u, v, z]) @ frame
        new_xyz.append(p)
        new_rgb.append(color_at(cloud, i, rows, p))
    return np.array(new_xyz), np.array(new_rgb)


def _disc_place(_local, h, draw):
    radius, angle = 1.5 * h * np.sqrt(draw[0]), 2 * np.pi * draw[1]
    return radius * np.cos(angle), radius * np.sin(angle)


def _triangle_place(local, _h, draw):
    """The base and a pair of its 8 nearest; pairs counted (0,1), (0,2), (1,2), (0,3) and so on."""
    pairs = [(a, b) for b in range(8) for a in range(b)]
    first, second = pairs[int(draw[2] * len(pairs))]
    root = np.sqrt(draw[0])
    return root * (1 - draw[1]) * local[first, :2] + root * draw[1] * local[second, :2]


def _box_place(local, _h, draw):
    low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    return low + draw * (high - low)


PLACEMENTS = {"disc": _disc_place, "triangle": _triangle_place, "box": _box_place}


def mls_surface(local, distance):
    """Eqs. 4-5: weighted degree-2 fit, w = 1 / max(d, d_1 / 2), with a small ridge."""
    reach = distance[-1]
    weight = 1.0 / np.maximum(np.append(distance, 0.0), 0.5 * distance[0])
    root = np.sqrt(weight)

    def terms(u, v):
        return np.array([1.0, u, v, u * u, u * v, v * v])

    design = np.array([terms(u, v) for u, v, _ in local / reach])
    ridge = 1e-6 * np.trace(design.T @ (weight[:, None] * design)) / 6
    left = np.concatenate([root[:, None] * design, np.sqrt(ridge) * np.eye(6)])
    right = np.concatenate([root * local[:, 2] / reach, np.zeros(6)])
    q = np.linalg.lstsq(left, right, rcond=None)[0]
    return lambda u, v: reach * (terms(u / reach, v / reach) @ q)


def _bspline_design(uv):
    """All 36 products of cubic B-splines at places in [-1, 1]^2, [m, 36]."""
    knots = -1.0 + (np.arange(10) - 3) * 2.0 / 3.0
    along_u, along_v = (BSpline.design_matrix(t, knots, 3).toarray() for t in uv.T)
    return np.array([np.kron(bu, bv) for bu, bv in zip(along_u, along_v, strict=True)])


def _roughness():
    """D2'D2 x I + 2 D1'D1 x D1'D1 + I x D2'D2."""
    d1, d2 = np.diff(np.eye(6), axis=0), np.diff(np.eye(6), n=2, axis=0)
    slopes, bends = d1.T @ d1, d2.T @ d2
    return np.kron(bends, np.eye(6)) + 2 * np.kron(slopes, slopes) + np.kron(np.eye(6), bends)


def pspline_surface(local, distance, smoothing=0.01):
    """Penalised 6 x 6 tensor-product cubic B-spline, by the dense normal equations."""
    unit = np.array([*np.abs(local[:, :2]).max(axis=0), 1.5 * distance[-1]])
    scaled = local / unit
    design, z = _bspline_design(scaled[:, :2]), scaled[:, 2]
    normal = design.T @ design + smoothing * _roughness() + 1e-9 * np.eye(36)
    c = np.linalg.solve(normal, design.T @ z)

    def surface(u, v):
        place = np.clip(np.array([[u, v]]) / unit[:2], -1.0, 1.0)
        return unit[2] * (_bspline_design(place) @ c).item()

    return surface
