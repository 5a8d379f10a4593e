"""Every method as a Python loop over new points, straight from the paper's text: the slow baseline.

Notation: eqs. are the paper's; a *base* is the original a new point starts from. Each function
makes one new point and returns (xyz [3], rgb [3]). Promise: the loop is a fair one. The kd-tree,
and for Voronoi the diagram, are built once; nothing is computed twice for one point; and the
paper's own parameters are used, which are cheaper than this package's defaults (fewer neighbours,
world axes, no outlier check). A ratio to these times is therefore a lower bound.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.interpolate import SmoothBivariateSpline
from scipy.spatial import ConvexHull, QhullError, Voronoi, cKDTree

from splatseed import PointCloud

__all__ = ["NAIVE", "Originals", "seconds_per_point"]

NewPoint = tuple[np.ndarray, np.ndarray]

MLS_NEIGHBORS = 10
SPLINE_NEIGHBORS = 25
SPLINE_SMOOTHING = 0.1 * SPLINE_NEIGHBORS
VORONOI_NEIGHBORS = 5
VORONOI_SITES = 115_000
VORONOI_HULLS = 500


@dataclass(frozen=True, eq=False)
class Originals:
    """The input of every loop.

    Args:
        xyz: Positions, float64 [N, 3].
        rgb: Colours, uint8 [N, 3].
    """

    xyz: Float64[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]

    @cached_property
    def tree(self) -> cKDTree:
        """A kd-tree over the positions."""
        return cKDTree(self.xyz)

    def blend(self, point: np.ndarray, around: np.ndarray) -> np.ndarray:
        """Inverse-distance weighted colour of rows ``around`` at ``point``."""
        weight = 1.0 / np.maximum(np.linalg.norm(self.xyz[around] - point, axis=1), 1e-9)
        return (weight @ self.rgb[around] / weight.sum()).round().astype(np.uint8)


def linear(originals: Originals, rng: np.random.Generator) -> NewPoint:
    """Eq. 1: on the segment to the nearest neighbour."""
    base = rng.integers(len(originals.xyz))
    other = originals.tree.query(originals.xyz[base], k=2)[1][1]
    a = rng.random()
    rgb = a * originals.rgb[base] + (1 - a) * originals.rgb[other]
    return a * originals.xyz[base] + (1 - a) * originals.xyz[other], rgb.round().astype(np.uint8)


def triangle(originals: Originals, rng: np.random.Generator) -> NewPoint:
    """Eq. 2: in the triangle with the two nearest neighbours."""
    base = rng.integers(len(originals.xyz))
    corners = originals.tree.query(originals.xyz[base], k=3)[1]
    weight = rng.dirichlet((1.0, 1.0, 1.0))
    return weight @ originals.xyz[corners], (weight @ originals.rgb[corners]).round().astype(
        np.uint8
    )


def mls(originals: Originals, rng: np.random.Generator) -> NewPoint:
    """Eqs. 4-5: on a weighted quadratic z = f(x, y)."""
    base, around, local = _neighborhood(originals, MLS_NEIGHBORS, rng)
    weight = np.sqrt(1.0 / np.maximum(np.linalg.norm(local, axis=1), 1e-9))
    q = np.linalg.lstsq(weight[:, None] * _quadratic(*local.T[:2]), weight * local[:, 2])[0]
    u, v = _in_box(local, rng)
    point = originals.xyz[base] + (u, v, (_quadratic(u, v) @ q).item())
    return point, originals.blend(point, around)


def _quadratic(u: np.ndarray | float, v: np.ndarray | float) -> np.ndarray:
    return np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])


def _neighborhood(
    originals: Originals, k: int, rng: np.random.Generator
) -> tuple[int, np.ndarray, np.ndarray]:
    """A random base, its k neighbours and itself, and their positions relative to it [k + 1, 3]."""
    base = int(rng.integers(len(originals.xyz)))
    around = originals.tree.query(originals.xyz[base], k=k + 1)[1]
    return base, around, originals.xyz[around] - originals.xyz[base]


def _in_box(local: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    return rng.uniform(low, high)


def spline(originals: Originals, rng: np.random.Generator) -> NewPoint:
    """Eq. 3: on FITPACK's smoothing spline z = S(x, y)."""
    base, around, local = _neighborhood(originals, SPLINE_NEIGHBORS, rng)
    surface = SmoothBivariateSpline(*local.T, s=SPLINE_SMOOTHING)
    u, v = _in_box(local, rng)
    point = originals.xyz[base] + (u, v, surface.ev(u, v))
    return point, originals.blend(point, around)


def bounding_box(originals: Originals, rng: np.random.Generator) -> NewPoint:
    """The ablation: anywhere in the bounding box."""
    low, high = _bounds(originals)
    return rng.uniform(low, high), originals.rgb[rng.integers(len(originals.rgb))]


def _bounds(originals: Originals) -> tuple[np.ndarray, np.ndarray]:
    return originals.tree.mins, originals.tree.maxes


@dataclass(frozen=True, eq=False)
class Cells:
    """Voronoi cells of the sites: vertices of each, and volumes to draw them by."""

    originals: Originals
    vertices: list[np.ndarray]
    cumulative: Float64[np.ndarray, " N"]

    def new_point(self, rng: np.random.Generator) -> NewPoint:
        """Eq. 6: in the ball (c, r / 2) of a cell drawn by volume."""
        cell = np.searchsorted(self.cumulative, rng.random() * self.cumulative[-1])
        vertices = self.vertices[cell]
        center = vertices.mean(axis=0)
        radius = np.linalg.norm(vertices - center, axis=1).max()
        ray = rng.normal(size=3)
        ray *= 0.5 * radius * rng.random() ** (1 / 3) / np.linalg.norm(ray)
        point = center + ray
        around = self.originals.tree.query(point, k=VORONOI_NEIGHBORS)[1]
        return point, self.originals.blend(point, around)


def _voronoi_seconds(
    originals: Originals, num_new: int, sample: int, rng: np.random.Generator
) -> float:
    """Seconds per new point: the diagram and all hulls shared out among ``num_new``, plus the loop.

    On clouds above ``VORONOI_SITES`` the diagram is built of that many and its time scaled up in
    proportion, less than Qhull would take; hulls are timed on ``VORONOI_HULLS`` cells.
    """
    num = len(originals.xyz)
    sites = originals.xyz[rng.permutation(num)[:VORONOI_SITES]]
    low, high = sites.min(axis=0), sites.max(axis=0)
    enlarged = np.stack([low, high]) + 0.05 * np.outer((-1, 1), high - low)
    corners = np.stack(np.meshgrid(*enlarged.T), axis=-1).reshape(-1, 3)
    started = time.perf_counter()
    diagram = Voronoi(np.concatenate([sites, corners]))
    per_site = (time.perf_counter() - started) / len(sites)
    timed = [
        diagram.vertices[diagram.regions[diagram.point_region[i]]]
        for i in rng.choice(len(sites), min(VORONOI_HULLS, len(sites)), replace=False)
    ]
    started = time.perf_counter()
    cumulative = np.cumsum([_volume(vertices) for vertices in timed])
    per_site += (time.perf_counter() - started) / len(timed)
    cells = Cells(originals, timed, cumulative)
    return per_site * num / num_new + _loop_seconds(lambda: cells.new_point(rng), sample)


def _volume(vertices: np.ndarray) -> float:
    try:
        return float(ConvexHull(vertices).volume)
    except QhullError:  # a cell too flat for Qhull counts as empty
        return 0.0


NAIVE: dict[str, Callable[[Originals, np.random.Generator], NewPoint]] = {
    "linear": linear,
    "triangle": triangle,
    "mls": mls,
    "spline": spline,
    "random": bounding_box,
}
"""One new point of each method; Voronoi, which has shared work, is timed apart."""


def seconds_per_point(method: str, cloud: PointCloud, num_new: int, sample: int = 2_000) -> float:
    """Seconds per new point of the naive loop.

    Args:
        method: A key of ``NAIVE``, or "voronoi".
        cloud: The originals.
        num_new: New points that would be made, among which shared work (Voronoi) is divided.
        sample: New points that are really made.
    """
    rng = np.random.default_rng(0)
    originals = Originals(cloud.xyz.astype(np.float64), cloud.rgb)
    originals.tree.query(originals.xyz[0])  # built before the clock starts
    if method == "voronoi":
        return _voronoi_seconds(originals, num_new, sample, rng)
    make = NAIVE[method]
    return _loop_seconds(lambda: make(originals, rng), sample)


def _loop_seconds(make: Callable[[], NewPoint], sample: int) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # FITPACK warns of nearly every patch
        make()
        started = time.perf_counter()
        made = [make() for _ in range(sample)]
        seconds = time.perf_counter() - started
    assert all(len(xyz) == 3 for xyz, _ in made)  # noqa: S101  (our own invariant)
    return seconds / sample
