"""Height-field patches: the steps of a method that fits a surface around every base point.

Around a base point p with k neighbours stands a frame (e_u, e_v, e_n), the rows of ``frames[i]``.
A surface is a height z = S(u, v) over the plane through p, and the new point at (u, v) is
p + u e_u + v e_v + z e_n. u, v and z are in scene units. The steps are frames (``frames``), places
(u, v) (``placement``), heights (a method's own ``heights``), the lift back to 3D, and colours.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64

from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.progress import Progress, blocks
from splatseed.upsample.colors import interpolate_colors
from splatseed.upsample.method import NewPoints, require
from splatseed.upsample.nearest import Draws, Known, NearestMethod
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.upsample.surfaces.frames import coordinate, local_frames, world_frames
from splatseed.upsample.surfaces.placement import place_in_box, place_in_triangle, place_on_disc

BLOCK = 1 << 13
"""Base points that are fitted between two updates of the progress bar."""
MIN_NEIGHBORS = 3
"""Points other than the base that determine a plane with room for a height."""


@dataclass(frozen=True, eq=False)
class Patches:
    """One patch per row, and the places on it where new points go.

    Args:
        cloud: The prepared originals, n rows.
        neighbors: The k neighbours of each row.
        bases: The new points of each row, M in all.
        frames: Axes of each patch as rows e_u, e_v, e_n, float64 [n, 3, 3].
        collinear: Rows with a collinear neighbourhood, bool [n].
        uv: Position of each new point on its patch, float32 [M, 2], scene units.
    """

    cloud: PreparedCloud
    neighbors: Neighbors
    bases: Bases
    frames: Float64[np.ndarray, "n 3 3"]
    collinear: Bool[np.ndarray, " n"]
    uv: Float32[np.ndarray, "M 2"]


@dataclass(frozen=True)
class PatchMethod(NearestMethod, ABC):
    """Base of the methods that fit a height field to the neighbours of a base point."""

    k: int = 16
    """Neighbours in a fit."""
    frame: Literal["local", "world"] = "local"
    """Axes of the fit: the neighbourhood's principal axes, or the world's (paper: world)."""
    placement: Literal["disc", "triangle", "box"] = "disc"
    """Where points are placed: a disc (best coverage), a triangle of neighbours (most exact), a
    box (paper: box)."""
    disc_radius: float = 1.5
    """Radius of the disc in units of the base point's spacing."""
    clamp: float | None = 0.25
    """How far a height may leave the neighbours' range, as a fraction of it (paper: no limit)."""

    min_points: ClassVar[int] = 4
    name: ClassVar[str]

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.k >= MIN_NEIGHBORS, f"{self.name}.k of at least {MIN_NEIGHBORS}", self.k)
        require(self.disc_radius > 0, f"{self.name}.disc_radius above 0", self.disc_radius)
        require(
            self.clamp is None or self.clamp >= 0, f"{self.name}.clamp of at least 0", self.clamp
        )

    @abstractmethod
    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write S(u, v) of all their new points into ``out`` [M]."""

    @property
    def num_neighbors(self) -> int:
        """Neighbours in a fit."""
        return self.k

    def place(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        known: Known,  # noqa: ARG002  (the base's)
        bases: Bases,
        rng: Draws,
        progress: Progress,
    ) -> NewPoints:
        """Fit a patch to every base and put its points on it."""
        patches = self._patches(cloud, neighbors, bases, rng)
        height = np.empty(bases.total, np.float32)
        for first, last in blocks(cloud.num_own, BLOCK, self.name, progress):
            self.heights(patches, first, last, height)
        xyz = lift(patches, height, self.clamp)
        return NewPoints(xyz, interpolate_colors(cloud, neighbors, bases, xyz))

    def _patches(
        self, cloud: PreparedCloud, neighbors: Neighbors, bases: Bases, rng: Draws
    ) -> Patches:
        """Put a patch on every row and choose where its new points go."""
        if self.frame == "local":
            frames, collinear = local_frames(cloud.xyz, neighbors.idx)
        else:
            frames, collinear = world_frames(len(neighbors.idx))
        if self.placement == "disc":
            uv = place_on_disc(neighbors, bases, collinear, self.disc_radius, rng)
        elif self.placement == "triangle":
            uv = place_in_triangle(cloud, neighbors, bases, frames, rng)
        else:
            uv = place_in_box(cloud, neighbors, bases, frames, rng)
        return Patches(cloud, neighbors, bases, frames, collinear, uv)


def lift(
    patches: Patches, height: Float32[np.ndarray, " M"], clamp: float | None
) -> Float32[np.ndarray, "M 3"]:
    """World positions of the new points, float32 [M, 3].

    Args:
        patches: The patches.
        height: S(u, v) of every new point, float32 [M].
        clamp: Heights are clamped to the neighbours' range, widened on both sides by this fraction
            of it; None leaves them unchanged.
    """
    cloud, bases = patches.cloud, patches.bases
    out = np.empty((bases.total, 3), np.float32)
    margin = np.inf if clamp is None else float(clamp)
    _lift(
        cloud.xyz, cloud.center, patches.neighbors.idx, patches.frames,
        bases.start, bases.count, patches.uv, height, margin, out,
    )  # fmt: skip
    return out


@kernel
def _lift(xyz, center, idx, frames, start, count, uv, height, margin, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Compute p + u e_u + v e_v + clamp(z) e_n for all new points of all rows."""
    for i in parallel_range(len(count)):
        if count[i] > 0:
            e_u, e_v, e_n = frames[i, 0], frames[i, 1], frames[i, 2]
            low, high = _height_range(xyz, i, idx[i], e_n)
            # No fit is trusted far beyond the heights it was made from.
            slack = margin * (high - low) if margin < np.inf else np.inf
            for m in range(start[i], start[i] + count[i]):
                u, v = np.float64(uv[m, 0]), np.float64(uv[m, 1])
                z = min(max(np.float64(height[m]), low - slack), high + slack)
                for axis in range(3):
                    # p + u e_u + v e_v + z e_n, relative to the centroid until the last sum
                    local = u * e_u[axis] + v * e_v[axis] + z * e_n[axis]
                    out[m, axis] = center[axis] + (xyz[i, axis] + local)


@inline
def _height_range(xyz, i, rows, e_n):  # type: ignore[no-untyped-def]  # Numba's types
    """Lowest and highest of the neighbours and the base (at 0) along the normal."""
    low = high = 0.0
    for j in rows:
        z = coordinate(xyz, i, j, e_n)
        low = min(low, z)
        high = max(high, z)
    return low, high
