"""The base of every method that starts from a base point and its nearest neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Float64

from splatseed.errors import PointCloudError
from splatseed.upsample.method import check_fields
from splatseed.upsample.neighbors import Neighbors, PreparedCloud, sound_bases

__all__ = ["NearestMethod"]

OUTLIER_CHECK_NEIGHBORS = 8


@dataclass(frozen=True)
class NearestMethod:
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

    def neighborhoods(
        self, cloud: PreparedCloud, k: int
    ) -> tuple[Neighbors, Float64[np.ndarray, " n"]]:
        """At least ``k`` neighbours of every row, and each row's weight as a base [n].

        Raises:
            PointCloudError: The cloud has fewer distinct points than the method needs.
        """
        if len(cloud) < self.min_points:
            raise PointCloudError(
                f"at least {self.min_points} distinct finite points for {type(self).__name__}",
                found=f"{len(cloud)}",
                fix="Use a cloud with more points, or the method 'random'.",
            )
        if not self.reject_isolated:
            return cloud.neighbors(k), np.ones(len(cloud))
        neighbors = cloud.neighbors(max(k, OUTLIER_CHECK_NEIGHBORS))
        return neighbors, sound_bases(cloud, neighbors)
