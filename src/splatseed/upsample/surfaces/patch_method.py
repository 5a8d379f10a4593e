"""The steps of a method that fits a height field: frames, placement, heights, colours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float32

from splatseed.progress import Progress, blocks
from splatseed.upsample.colors import interpolate_colors
from splatseed.upsample.method import NewPoints, require
from splatseed.upsample.nearest import Draws, Known, NearestMethod
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.upsample.surfaces.frames import local_frames, world_frames
from splatseed.upsample.surfaces.patches import Patches, lift
from splatseed.upsample.surfaces.placement import place_in_box, place_in_triangle, place_on_disc

__all__ = ["PatchMethod"]

BLOCK = 1 << 13
MIN_NEIGHBORS = 3


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
