"""What images observe of Structure-from-Motion's points: features, and tracks through images.

Notation: as in ``scene``, an ``_id`` comes from a file and may have gaps. Promise: both are frozen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt32

from splatseed.frozen import freeze

NO_POINT = -1
"""Point id of a feature without a point."""


@dataclass(frozen=True, eq=False)
class Observations:
    """The features of one image."""

    xy: Float64[np.ndarray, "M 2"]  # pixel coordinates
    point_ids: Int64[np.ndarray, " M"]  # of the 3D point each belongs to; ``NO_POINT`` = none

    def __post_init__(self) -> None:
        freeze(self, "xy", "point_ids")

    def __len__(self) -> int:
        return len(self.point_ids)

    def __repr__(self) -> str:
        belong = np.count_nonzero(self.point_ids != NO_POINT)
        return f"Observations({len(self):,} features, {belong:,} of them of points)"

    def without(self, point_ids: Int64[np.ndarray, " P"] | None) -> Observations:
        """Return the features with ``NO_POINT`` for those of some points, or of all (None)."""
        gone = True if point_ids is None else np.isin(self.point_ids, point_ids)
        return Observations(self.xy, np.where(gone, NO_POINT, self.point_ids))


@dataclass(frozen=True, eq=False)
class Tracks:
    """The observations and reprojection errors of Structure-from-Motion's points.

    The observations of point i are ``image_ids[offsets[i]:offsets[i + 1]]`` and the features
    ``point2d_idx`` of those images.
    """

    point_ids: Int64[np.ndarray, " N"]
    xyz: Float64[np.ndarray, "N 3"]  # the file's, as originals are written back exactly
    errors: Float64[np.ndarray, " N"]  # mean reprojection error, px; -1 where unknown
    offsets: Int64[np.ndarray, " N+1"]  # rising from 0 to T
    image_ids: UInt32[np.ndarray, " T"]
    point2d_idx: UInt32[np.ndarray, " T"]

    def __post_init__(self) -> None:
        freeze(self, "point_ids", "xyz", "errors", "offsets", "image_ids", "point2d_idx")

    def __len__(self) -> int:
        return len(self.point_ids)

    def __repr__(self) -> str:
        return f"Tracks({len(self):,} points, {len(self.image_ids):,} observations)"

    @property
    def lengths(self) -> Int64[np.ndarray, " N"]:
        """Observations per point, int64 [N]."""
        return np.diff(self.offsets)

    def select(self, keep: Bool[np.ndarray, " N"]) -> Tracks:
        """Return the tracks of the points marked in ``keep``, in their order."""
        observed = np.repeat(keep, self.lengths)
        return Tracks(
            point_ids=self.point_ids[keep],
            xyz=self.xyz[keep],
            errors=self.errors[keep],
            offsets=np.concatenate([[0], np.cumsum(self.lengths[keep])]).astype(np.int64),
            image_ids=self.image_ids[observed],
            point2d_idx=self.point2d_idx[observed],
        )

    def seen_by(self, image_ids: Sequence[int]) -> Tracks:
        """Return the tracks without the observations of other images than these."""
        kept = np.isin(self.image_ids, image_ids)
        point_idx = np.repeat(np.arange(len(self)), self.lengths)[kept]
        lengths = np.bincount(point_idx, minlength=len(self))
        return replace(
            self,
            offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            image_ids=self.image_ids[kept],
            point2d_idx=self.point2d_idx[kept],
        )
