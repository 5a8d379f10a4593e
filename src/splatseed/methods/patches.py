"""PatchMethod: the base of methods that fit a height field around each base point.

The frame of a base point p with k neighbours has the rows e_u, e_v (the tangent plane, widest
axis first) and e_n (the normal) of ``frames[i]`` [3, 3], right-handed. A surface is a height
z = S(u, v) over the plane through p, and the new point at (u, v) is p + u e_u + v e_v + z e_n.
u, v and z are in scene units. The steps are frames, places (u, v), heights (a method's own
``heights``), the lift back to 3D, and colours.
Promise: principal axes and their signs follow from the neighbourhood's shape alone, so they rotate
with the cloud; a collinear neighbourhood is reported, as its tangent plane is arbitrary, and gets
v = 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from splatseed.methods._kernels import patches as kernels
from splatseed.methods.nearest import Aux, NearestMethod, interpolate_colors
from splatseed.methods.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks
from splatseed.settings import Range

COLLINEAR = 1e-9
"""Ratio of the two largest variances below which a neighbourhood counts as collinear."""


def local_frames(
    xyz: Float64[np.ndarray, "n 3"], idx: Int32[np.ndarray, "m k"]
) -> tuple[Float64[np.ndarray, "m 3 3"], Bool[np.ndarray, " m"]]:
    """Compute the axes e_u, e_v, e_n of m neighbourhoods, and mark the collinear ones."""
    frames, collinear = np.empty((len(idx), 3, 3)), np.empty(len(idx), bool)
    kernels.fill_frames(xyz, idx, frames, collinear, COLLINEAR)
    return frames, collinear


TRIANGLE_NEIGHBORS = 8  # neighbours from which the other two corners are drawn


def place_on_disc(
    neighbors: Neighbors,
    bases: Bases,
    collinear: Bool[np.ndarray, " n"],
    radius: float,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "M 2"]:
    """Draw positions uniform in the disc of ``radius`` times the base point's spacing."""
    uv = rng.random((bases.total, 2), dtype=np.float32)
    kernels.sample_disc(radius * neighbors.spacing, collinear, bases.start, bases.count, uv)
    return uv


def place_in_triangle(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    frames: Float64[np.ndarray, "n 3 3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "M 2"]:
    """Draw positions uniform in the triangle of the base and two random ones of its 8 nearest."""
    draws = rng.random((bases.total, 3), dtype=np.float32)
    uv = np.empty((bases.total, 2), np.float32)
    idx = neighbors.idx[:, :TRIANGLE_NEIGHBORS].copy()
    kernels.sample_triangle(cloud.xyz, idx, frames, bases.start, bases.count, draws, uv)
    return uv


def place_in_box(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    frames: Float64[np.ndarray, "n 3 3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "M 2"]:
    """Draw positions uniform in the neighbourhood's bounding box along e_u and e_v (paper)."""
    uv = rng.random((bases.total, 2), dtype=np.float32)
    kernels.sample_box(cloud.xyz, neighbors.idx, frames, bases.start, bases.count, uv)
    return uv


BLOCK = 1 << 13  # base points that are fitted between two updates of the progress bar
MIN_NEIGHBORS = 3  # points other than the base that determine a plane with room for a height
FitSize = Annotated[int, Range(MIN_NEIGHBORS)]


@dataclass(frozen=True, eq=False)
class Patches:
    """A patch per row: its axes, and the positions (u, v) of its new points."""

    cloud: PreparedCloud
    neighbors: Neighbors
    bases: Bases
    frames: Float64[np.ndarray, "n 3 3"]
    uv: Float32[np.ndarray, "M 2"]


@dataclass(frozen=True)
class PatchMethod(NearestMethod, ABC):
    """Base of methods that fit a height field to the neighbours of a base point."""

    k: FitSize = 16
    """Neighbours in a fit."""
    frame: Literal["local", "world"] = "local"
    """Axes of the fit: the neighbourhood's principal axes, or the world's (paper: world)."""
    placement: Literal["disc", "triangle", "box"] = "disc"
    """Area of new points: a disc (best coverage), a triangle of neighbours (smallest error) or a
    box (paper: box)."""
    disc_radius: Annotated[float, Range(above=0)] = 1.5
    """Radius of the disc in units of the base point's spacing."""
    clamp: Annotated[float | None, Range(0)] = 0.25
    """Maximum height beyond the neighbours' range, as a fraction of it (paper: none)."""

    min_points: ClassVar[int] = 4
    name: ClassVar[str]

    @abstractmethod
    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write S(u, v) of all their new points into ``out`` [M]."""

    @property
    def num_neighbors(self) -> int:
        """Neighbours in a fit."""
        return self.k

    def sample(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        aux: Aux,
        bases: Bases,
        rng: np.random.Generator,
        progress: Progress,
    ) -> PointCloud:
        """Fit a patch to each base and put its points on it."""
        patches = self._patches(cloud, neighbors, bases, rng)
        height = np.empty(bases.total, np.float32)
        for first, last in blocks(len(cloud), BLOCK, self.name, progress):
            self.heights(patches, first, last, height)
        xyz = lift(patches, height, self.clamp)
        return PointCloud(xyz, interpolate_colors(cloud, neighbors, bases, xyz))

    def _patches(
        self, cloud: PreparedCloud, neighbors: Neighbors, bases: Bases, rng: np.random.Generator
    ) -> Patches:
        if self.frame == "local":
            frames, collinear = local_frames(cloud.xyz, neighbors.idx)
        else:
            n = len(neighbors.idx)
            frames, collinear = np.tile(np.eye(3), (n, 1, 1)), np.zeros(n, bool)
        if self.placement == "disc":
            uv = place_on_disc(neighbors, bases, collinear, self.disc_radius, rng)
        elif self.placement == "triangle":
            uv = place_in_triangle(cloud, neighbors, bases, frames, rng)
        else:
            uv = place_in_box(cloud, neighbors, bases, frames, rng)
        return Patches(cloud, neighbors, bases, frames, uv)


def lift(
    patches: Patches, height: Float32[np.ndarray, " M"], clamp: float | None
) -> Float32[np.ndarray, "M 3"]:
    """Compute world positions at heights S(u, v).

    Heights are clamped to the neighbours' range, extended on both sides by its fraction ``clamp``;
    None for no limit.
    """
    cloud, bases = patches.cloud, patches.bases
    out = np.empty((bases.total, 3), np.float32)
    margin = np.inf if clamp is None else float(clamp)
    kernels.lift(
        cloud.xyz, cloud.center, patches.neighbors.idx, patches.frames,
        bases.start, bases.count, patches.uv, height, margin, out,
    )  # fmt: skip
    return out
