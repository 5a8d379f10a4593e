"""Discs: hundreds of small round leaves in one surface.

Notation: leaf j is the flat disc with ``centers[j]``, unit ``axes[j]`` and ``radii[j]``; L leaves,
N points or rays. Promise: every leaf is tested, so distances and hits are exact; the loops are
compiled and keep no [N, L] array.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64

from splatseed.kernels.jit import inline
from splatseed.synthetic.surfaces import Sphere


@dataclass(frozen=True, eq=False)
class Discs:
    """Flat round leaves.

    Args:
        centers: Their centres, float64 [L, 3].
        axes: Their unit normals, float64 [L, 3].
        radii: Their radii, float64 [L].
    """

    centers: Float64[np.ndarray, "L 3"]
    axes: Float64[np.ndarray, "L 3"]
    radii: Float64[np.ndarray, " L"]

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return float(np.pi * (self.radii**2).sum())

    @cached_property
    def _bound(self) -> Sphere:
        """A sphere around all leaves: most rays of a photograph miss it."""
        center = (self.centers.min(axis=0) + self.centers.max(axis=0)) / 2
        reach = np.linalg.norm(self.centers - center, axis=1) + self.radii
        return Sphere(center, float(reach.max()) * (1 + 1e-9))

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        return np.asarray(self._nearest(xyz)[0])

    def _nearest(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = np.ascontiguousarray(xyz, np.float64)
        distances, which = _nearest_disc(points, self.centers, self.axes, self.radii)
        return np.asarray(distances), np.asarray(which)

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        leaf = rng.choice(len(self.radii), num, p=self.radii**2 / (self.radii**2).sum())
        axis = self.axes[leaf]
        # Any direction in the leaf's plane will do; one from a random vector is uniform in angle.
        across = np.cross(axis, rng.normal(size=(num, 3)))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        radius = self.radii[leaf] * np.sqrt(rng.random(num))
        return np.asarray(self.centers[leaf] + radius[:, None] * across)

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        t = np.full(len(directions), np.inf)
        near = np.flatnonzero(np.isfinite(self._bound.intersect(origin, directions)))
        t[near] = _first_disc(origin, directions[near], self.centers, self.axes, self.radii)
        return t

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        return np.asarray(self.axes[self._nearest(xyz)[1]])


@inline
def _nearest_disc(
    xyz: np.ndarray,  # float64 [N, 3]
    centers: np.ndarray,  # float64 [L, 3]
    axes: np.ndarray,  # float64 [L, 3]
    radii: np.ndarray,  # float64 [L]
) -> tuple[np.ndarray, np.ndarray]:  # float64 [N], int64 [N]
    """Distance to the nearest disc and its index."""
    distances = np.empty(len(xyz))
    which = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        best, best_j = np.inf, 0
        for j in range(len(radii)):
            x = xyz[i, 0] - centers[j, 0]
            y = xyz[i, 1] - centers[j, 1]
            z = xyz[i, 2] - centers[j, 2]
            off = x * axes[j, 0] + y * axes[j, 1] + z * axes[j, 2]
            x, y, z = x - off * axes[j, 0], y - off * axes[j, 1], z - off * axes[j, 2]
            # Within the disc's plane: how far beyond its rim.
            beyond = max(np.sqrt(x * x + y * y + z * z) - radii[j], 0.0)
            squared = off * off + beyond * beyond
            if squared < best:
                best, best_j = squared, j
        distances[i] = np.sqrt(best)
        which[i] = best_j
    return distances, which


@inline
def _first_disc(
    origin: np.ndarray,  # float64 [3]
    directions: np.ndarray,  # float64 [N, 3]
    centers: np.ndarray,  # float64 [L, 3]
    axes: np.ndarray,  # float64 [L, 3]
    radii: np.ndarray,  # float64 [L]
) -> np.ndarray:  # float64 [N]
    """Smallest t > 0 at which each ray meets a disc; inf where none does."""
    nearest = np.full(len(directions), np.inf)
    for j in range(len(radii)):
        nx, ny, nz = axes[j, 0], axes[j, 1], axes[j, 2]
        ox, oy, oz = origin[0] - centers[j, 0], origin[1] - centers[j, 1], origin[2] - centers[j, 2]
        height = ox * nx + oy * ny + oz * nz
        limit = radii[j] * radii[j]
        for i in range(len(directions)):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            # Where the ray meets the disc's plane; infinite if parallel, and then no hit.
            t = -height / (dx * nx + dy * ny + dz * nz)
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            if t > 0.0 and t < nearest[i] and x * x + y * y + z * z <= limit:
                nearest[i] = t
    return nearest
