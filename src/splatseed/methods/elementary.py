"""Points between nearest neighbours (paper, eqs. 1 and 2), and anywhere in the bounding box.

Linear: P = a P1 + (1 - a) P2 with a ~ U[0, 1], P1 a random original and P2 its nearest neighbour.
Triangular: P = b0 P1 + b1 P2 + b2 P3 with the two nearest, (b0, b1, b2) uniform in the triangle:
the barycentric weights come from the square-root map. Colours likewise. Promise: each new point
lies between two originals, or in the triangle of three.

Random, the paper's ablation: xyz uniform in the axis-aligned bounding box of the originals, rgb
drawn from the originals.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.methods._kernels import nearest as kernels
from splatseed.methods.nearest import Aux, NearestMethod
from splatseed.methods.neighbors import Bases, Neighbors, PreparedCloud, prepare_scene
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene

BLOCK = 1 << 18


class _Simplex(NearestMethod):
    name: ClassVar[str]

    def sample(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        aux: Aux,
        bases: Bases,
        rng: np.random.Generator,
        progress: Progress,
    ) -> PointCloud:
        """Make the points of all bases."""
        num = bases.total
        draws = rng.random((num, 2) if self.num_neighbors == 2 else num, dtype=np.float32)
        progress(self.name, 0.0)
        xyz, rgb = np.empty((num, 3), np.float32), np.empty((num, 3), np.uint8)
        self._fill(
            cloud.xyz, cloud.rgb, cloud.center, neighbors.idx, bases.start, bases.count,
            draws, xyz, rgb,
        )  # fmt: skip
        progress(self.name, 1.0)
        return PointCloud(xyz, rgb)

    @staticmethod
    @abstractmethod
    def _fill(*arrays: np.ndarray) -> None:
        """Fill positions and colours by a kernel."""


@dataclass(frozen=True)
class Linear(_Simplex):
    """Points on the segments between originals and their nearest neighbours (eq. 1)."""

    name: ClassVar[str] = "linear"
    num_neighbors: ClassVar[int] = 1

    @staticmethod
    def _fill(*arrays: np.ndarray) -> None:
        kernels.sample_segments(*arrays)


@dataclass(frozen=True)
class Triangle(_Simplex):
    """Points in the triangles of originals and their two nearest neighbours (eq. 2)."""

    name: ClassVar[str] = "triangle"
    min_points: ClassVar[int] = 3
    num_neighbors: ClassVar[int] = 2

    @staticmethod
    def _fill(*arrays: np.ndarray) -> None:
        kernels.sample_triangles(*arrays)


@dataclass(frozen=True)
class BoundingBox:
    """Points uniform in the bounding box, coloured as random originals: the baseline."""

    name: ClassVar[str] = "random"

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> PointCloud:
        """Make ``num_new`` points."""
        cloud = prepare_scene(scene, progress)
        low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
        progress("random", 0.0)
        xyz = rng.random((num_new, 3), dtype=np.float32)
        for start in range(0, num_new, BLOCK):  # sums in float64 without a whole float64 cloud
            part = xyz[start : start + BLOCK]
            part[...] = in_box(part, low, high, cloud.center)
        by_rank = np.empty_like(cloud.rgb)
        by_rank[cloud.rank] = cloud.rgb
        rgb = by_rank[rng.integers(0, len(cloud), num_new, dtype=np.int32)]
        progress("random", 1.0)
        return PointCloud(xyz, rgb)


def in_box(
    draws: Float32[np.ndarray, "m 3"],
    low: Float64[np.ndarray, " 3"],
    high: Float64[np.ndarray, " 3"],
    center: Float64[np.ndarray, " 3"],
) -> Float64[np.ndarray, "m 3"]:
    """Map numbers from 0 to 1 to a box relative to ``center``; world positions."""
    return np.asarray(low + center + draws * (high - low))
