"""NearestMethod: the base of methods that make points from a base point and its neighbours.

``base_weights`` gives the probability of each row to be a base; bases are drawn; ``sample`` makes
the points.

Colours: c = sum_j w_j c_j / sum_j w_j over the base point and its neighbours, with
w_j = 1 / max(|p - p_j|, 0.01 h), h the base point's spacing, in linear arithmetic on the 8-bit
values as in the paper, rounded to the nearest. Points that may lie far from their base can take the
originals nearest to themselves instead (``colors_of_nearest``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self, TypeAlias

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.errors import PointCloudError
from splatseed.methods._kernels import nearest as kernels
from splatseed.methods.neighbors import (
    QUERY_BLOCK,
    Bases,
    Neighbors,
    PreparedCloud,
    draw_bases,
    prepare_scene,
    sound_bases,
)
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads
from splatseed.scene import Scene
from splatseed.settings import check_settings

OUTLIER_CHECK_NEIGHBORS = 8

Aux: TypeAlias = Mapping[str, np.ndarray]
"""Arrays [n, ...] by name that ``base_weights`` computes and ``sample`` uses again."""


@dataclass(frozen=True)
class NearestMethod(ABC):
    """Base of methods that use only the nearest neighbours of a base point."""

    reject_isolated: bool = True
    """Draw no bases from isolated points, or from points with a short and bad track (paper: no)."""

    min_points: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_settings(self, getattr(self, "name", type(self).__name__.lower()))

    @classmethod
    def paper(cls) -> Self:
        """Return the parameters of the paper's text."""
        return cls(reject_isolated=False)

    @property
    @abstractmethod
    def num_neighbors(self) -> int:
        """Neighbours that points are made from."""

    @property
    def num_queried(self) -> int:
        """Neighbours to query: for the points, and for the test of isolation."""
        if not self.reject_isolated:
            return self.num_neighbors
        return max(self.num_neighbors, OUTLIER_CHECK_NEIGHBORS)

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> PointCloud:
        """Make ``num_new`` points."""
        cloud = prepare_scene(scene, progress)
        self.check_enough(len(cloud))
        neighbors = cloud.neighbors(self.num_queried)
        weight, aux = self.base_weights(cloud, neighbors, progress)
        neighbors = neighbors.nearest(self.num_neighbors)
        bases = draw_bases(cloud, num_new, rng, weight=weight)
        return self.sample(cloud, neighbors, aux, bases, rng, progress)

    def check_enough(self, number: int) -> None:
        """Raise a ``PointCloudError`` if there are fewer distinct points than the method needs."""
        if number < self.min_points:
            raise PointCloudError(
                f"at least {self.min_points} distinct finite points for {type(self).__name__}",
                found=f"{number}",
                fix="Use a cloud with more points, or the method 'random'.",
            )

    def base_weights(
        self, cloud: PreparedCloud, neighbors: Neighbors, progress: Progress
    ) -> tuple[Float64[np.ndarray, " n"], Aux]:
        """Return each row's weight as a base, and arrays for ``sample``.

        ``neighbors`` has ``num_queried`` per row.
        """
        if not self.reject_isolated:
            return np.ones(len(cloud)), {}
        return sound_bases(cloud, neighbors), {}

    @abstractmethod
    def sample(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        aux: Aux,
        bases: Bases,
        rng: np.random.Generator,
        progress: Progress,
    ) -> PointCloud:
        """Make the points of all bases; ``neighbors`` has ``num_neighbors`` per row."""


FLOOR = 0.01  # lower limit of distances, in units of the base point's spacing


def interpolate_colors(
    cloud: PreparedCloud, neighbors: Neighbors, bases: Bases, new_xyz: Float32[np.ndarray, "M 3"]
) -> UInt8[np.ndarray, "M 3"]:
    """Blend the colours of base and neighbours at world positions ``new_xyz``."""
    rgb = np.empty((bases.total, 3), np.uint8)
    kernels.interpolate(
        cloud.xyz, cloud.rgb, cloud.center, neighbors.idx, FLOOR * neighbors.spacing,
        bases.start, bases.count, new_xyz, rgb,
    )  # fmt: skip
    return rgb


def colors_of_nearest(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    local_xyz: Float32[np.ndarray, "M 3"],
    k: int,
    progress: Progress,
) -> UInt8[np.ndarray, "M 3"]:
    """Blend the colours of the k originals nearest to each new point.

    Positions are relative to the cloud's centre: float32 world coordinates far from 0 are too
    coarse.
    """
    rgb, spacing = np.empty_like(cloud.rgb), np.empty(len(cloud))
    rgb[cloud.rank], spacing[cloud.rank] = cloud.rgb, neighbors.spacing
    out = np.empty((len(local_xyz), 3), np.uint8)
    nth = np.arange(1, min(k, len(cloud)) + 1)

    def work(start: int, stop: int) -> None:
        distance, number = cloud.tree.query(local_xyz[start:stop], nth)
        weight = 1.0 / np.maximum(distance, FLOOR * spacing[number[:, :1]])
        weight /= weight.sum(axis=1, keepdims=True)
        out[start:stop] = np.einsum("mk,mkc->mc", weight, rgb[number]) + 0.5

    in_threads(work, len(local_xyz), QUERY_BLOCK, "colours", progress)
    return out
