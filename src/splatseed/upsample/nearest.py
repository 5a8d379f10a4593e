"""The base of every method that starts from a base point and its nearest neighbours.

Such a method has two steps with the draw of the bases between them: ``weigh`` says how likely each
row is a base, ``place`` makes the points. Promise: both look at a row and the neighbours it is
given only, so that they give the same for a cloud in tiles (``splatseed.tiles``) as for the whole.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, TypeAlias

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.errors import PointCloudError
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.upsample.method import NewPoints, check_fields
from splatseed.upsample.neighbors import (
    Bases,
    Neighbors,
    PreparedCloud,
    draw_bases,
    prepare_scene,
    sound_bases,
)

OUTLIER_CHECK_NEIGHBORS = 8

Known: TypeAlias = Mapping[str, np.ndarray]
"""What ``weigh`` has found out about rows and ``place`` needs: arrays [n, ...] by name."""


class Draws(Protocol):
    """A source of uniform numbers: a NumPy generator, or the part of its stream that a tile has."""

    def random(self, size: Any, dtype: Any) -> Float32[np.ndarray, "..."]:
        """Numbers from 0 to 1, float32; the first axis is that of the new points."""
        ...


@dataclass(frozen=True)
class NearestMethod(ABC):
    """Base of the methods that need only the nearest neighbours of a base point."""

    reject_isolated: bool = True
    """Start nothing from isolated points, or from ones with a short, bad track (paper: no)."""

    min_points: ClassVar[int] = 2

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def paper(cls) -> Self:
        """The parameters that follow the paper to the letter."""
        return cls(reject_isolated=False)

    @property
    @abstractmethod
    def num_neighbors(self) -> int:
        """Neighbours that points are made from."""

    @property
    def whole(self) -> str:
        """What the method computes from all points at once; empty if it computes nothing so."""
        return ""

    @property
    def num_queried(self) -> int:
        """Neighbours to look for: those that points are made from, or that isolation shows in."""
        if not self.reject_isolated:
            return self.num_neighbors
        return max(self.num_neighbors, OUTLIER_CHECK_NEIGHBORS)

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make ``num_new`` points."""
        cloud = prepare_scene(scene, progress)
        self.check_enough(len(cloud))
        neighbors = cloud.neighbors(self.num_queried)
        weight, known = self.weigh(cloud, neighbors, progress)
        neighbors = neighbors.nearest(self.num_neighbors)
        bases = draw_bases(cloud, num_new, rng, weight=weight)
        return self.place(cloud, neighbors, known, bases, rng, progress)

    def check_enough(self, number: int) -> None:
        """Refuse a cloud with fewer distinct points than the method needs.

        Raises:
            PointCloudError: It has.
        """
        if number < self.min_points:
            raise PointCloudError(
                f"at least {self.min_points} distinct finite points for {type(self).__name__}",
                found=f"{number}",
                fix="Use a cloud with more points, or the method 'random'.",
            )

    def weigh(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        progress: Progress,  # noqa: ARG002  (some methods take long)
    ) -> tuple[Float64[np.ndarray, " n"], Known]:
        """Each own row's weight as a base, [n], and what ``place`` is to know of own rows.

        Args:
            cloud: The prepared originals.
            neighbors: ``num_queried`` neighbours, of own rows and of all their neighbours.
            progress: Told the stage.
        """
        if not self.reject_isolated:
            return np.ones(cloud.num_own), {}
        return sound_bases(cloud, neighbors), {}

    @abstractmethod
    def place(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        known: Known,
        bases: Bases,
        rng: Draws,
        progress: Progress,
    ) -> NewPoints:
        """Make the points of all bases.

        Args:
            cloud: The prepared originals.
            neighbors: ``num_neighbors`` neighbours of own rows.
            known: What ``weigh`` has found.
            bases: How many points each own row makes.
            rng: Where random numbers come from.
            progress: Told the stage.
        """


def blended(
    blend: Callable[..., None],
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    draws: Float32[np.ndarray, "new ..."],
) -> NewPoints:
    """New points that a kernel blends from each base and its neighbours.

    Args:
        blend: A kernel of positions, colours, centre, neighbours, each row's first new point and
            number of them, and draws; it fills positions and colours.
        cloud: The prepared originals.
        neighbors: Neighbours of own rows.
        bases: How many points each own row makes.
        draws: Uniform numbers, a row per new point.
    """
    new = NewPoints(np.empty((len(draws), 3), np.float32), np.empty((len(draws), 3), np.uint8))
    blend(
        cloud.xyz, cloud.rgb, cloud.center, neighbors.idx, bases.start, bases.count, draws,
        new.xyz, new.rgb,
    )  # fmt: skip
    return new
