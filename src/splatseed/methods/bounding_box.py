"""Random points in the bounding box: the paper's ablation.

xyz uniform in the axis-aligned bounding box of the originals, rgb drawn from the originals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.methods.neighbors import prepare_scene
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene

BLOCK = 1 << 18


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
