"""PointCloud: coloured points, and which of them are the originals.

Notation: N points; ``xyz`` in scene units and the scene's world frame; ``rgb`` 8-bit sRGB as stored
by COLMAP; ``source`` 0 for an original point, otherwise the code of the method that made the point.
Promise: arrays have the shapes and dtypes below and are read-only; methods return new clouds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace as dataclass_replace

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from splatseed.errors import PointCloudError

__all__ = ["GENERATED", "ORIGINAL", "PointCloud"]

ORIGINAL = 0
"""The ``source`` code of points that were in the input."""

GENERATED = 255
"""The ``source`` code of points made by a method that has no code of its own, or that is not known."""

_MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Coloured points in world coordinates.

    Args:
        xyz: Positions, float32 [N, 3], scene units, world frame.
        rgb: Colours, uint8 [N, 3].
        source: Origin of each point, uint8 [N]; 0 = original. All originals when left out.

    Raises:
        PointCloudError: The shapes or the colour type do not fit.

    Example:
        >>> import numpy as np
        >>> cloud = PointCloud(np.zeros((2, 3)), np.full((2, 3), 128, np.uint8))
        >>> len(cloud), int(cloud.source.sum())
        (2, 0)
    """

    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    source: UInt8[np.ndarray, " N"] = None  # type: ignore[assignment]  # filled in __post_init__

    def __post_init__(self) -> None:
        xyz = np.asarray(self.xyz)
        rgb = np.asarray(self.rgb)
        source = (
            np.full(len(xyz), ORIGINAL, np.uint8)
            if self.source is None
            else np.asarray(self.source)
        )
        _check_shapes(xyz, rgb, source)
        for name, array, dtype in (
            ("xyz", xyz, np.float32),
            ("rgb", rgb, np.uint8),
            ("source", source, np.uint8),
        ):
            object.__setattr__(self, name, _read_only(array, dtype))

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def num_original(self) -> int:
        """How many points come from the input."""
        return int(np.count_nonzero(self.source == ORIGINAL))

    @property
    def originals(self) -> PointCloud:
        """The points of the input alone, in their order."""
        return self.select(self.source == ORIGINAL)

    @property
    def finite(self) -> Bool[np.ndarray, " N"]:
        """Which points have three finite coordinates."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    @property
    def distinct(self) -> Bool[np.ndarray, " N"]:
        """Which points are finite and the first at their exact position (-0.0 equals 0.0)."""
        distinct = self.finite
        distinct[distinct] = _first_of_equals(self.xyz[distinct])
        return distinct

    def select(self, which: Bool[np.ndarray, " N"] | Int[np.ndarray, " M"] | slice) -> PointCloud:
        """The points at ``which`` (a mask, indices or a slice), in that order."""
        return PointCloud(self.xyz[which], self.rgb[which], self.source[which])

    def replace(self, **changes: np.ndarray) -> PointCloud:
        """A copy with some of its arrays replaced."""
        return dataclass_replace(self, **changes)

    @staticmethod
    def concatenate(*clouds: PointCloud) -> PointCloud:
        """The clouds one after another, each point keeping its ``source``."""
        return PointCloud(
            np.concatenate([c.xyz for c in clouds]),
            np.concatenate([c.rgb for c in clouds]),
            np.concatenate([c.source for c in clouds]),
        )


def _read_only(array: np.ndarray, dtype: type) -> np.ndarray:
    """A contiguous read-only view of ``array``; the caller's own array stays writable."""
    view: np.ndarray = np.ascontiguousarray(array, dtype=dtype).view()
    view.flags.writeable = False
    return view


def _first_of_equals(xyz: Float32[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Which of the finite rows equal no earlier one: exact, a hash only narrows the search."""
    xyz = np.ascontiguousarray(xyz + np.float32(0.0))  # adding turns -0.0 into 0.0
    suspects = np.flatnonzero(_hash_collides(xyz))
    rows = xyz[suspects].view(np.dtype((np.void, 3 * xyz.itemsize))).ravel()
    first = np.ones(len(xyz), bool)
    first[suspects] = False
    first[suspects[np.unique(rows, return_index=True)[1]]] = True
    return first


def _hash_collides(xyz: Float32[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Which rows share a 64-bit hash with another: ten times faster than sorting rows."""
    products = xyz.view(np.uint32).astype(np.uint64) * _MULTIPLIERS  # modulo 2^64
    hashes = products[:, 0] ^ (products[:, 1] >> np.uint64(17)) ^ (products[:, 2] << np.uint64(13))
    ordered = np.sort(hashes)
    repeated = ordered[1:][ordered[1:] == ordered[:-1]]
    if not len(repeated):
        return np.zeros(len(xyz), bool)
    return np.asarray(np.isin(hashes, repeated))


def _check_shapes(xyz: np.ndarray, rgb: np.ndarray, source: np.ndarray) -> None:
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        raise PointCloudError(
            "xyz as numbers of shape [N, 3]",
            found=f"{xyz.dtype} {list(xyz.shape)}",
            fix="Pass one row x, y, z a point.",
        )
    if rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise PointCloudError(
            f"rgb as uint8 of shape {list(xyz.shape)}",
            found=f"{rgb.dtype} {list(rgb.shape)}",
            fix="Scale colours to 0..255 and convert them with .astype(np.uint8).",
        )
    if source.shape != xyz.shape[:1]:
        raise PointCloudError(
            f"source of shape [{len(xyz)}]",
            found=f"{list(source.shape)}",
            fix="Pass one code a point, or leave it out.",
        )
