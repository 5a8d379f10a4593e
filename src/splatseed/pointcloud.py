"""PointCloud: coloured points with their origin and optional attributes.

Notation: N points; ``xyz`` in scene units and the scene's world frame; ``rgb`` 8-bit sRGB as stored
by COLMAP; ``source`` is 0 for an original point, otherwise the code of the method that made it:
the one record of a point's origin, which ``seeds.npz`` keeps in files. ``original_idx`` is the row
of an original in the cloud that it was selected from; by it a scene's tracks follow their points.
The *attributes* normals, sizes and confidence are optional, and NaN where unknown for a point.
Promise: arrays have the shapes and dtypes below, are read-only, and change with no array of the
caller's; methods return new clouds, in which every point keeps all its attributes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace as dataclass_replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from splatseed.errors import PointCloudError
from splatseed.frozen import read_only
from splatseed.text import visible

ORIGINAL = 0
"""``source`` code of points in the input."""

GENERATED = 255
"""``source`` code of added points whose method has no code of its own."""

ATTRIBUTES: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {"normals": (3,), "sizes": (), "confidence": ()}
)
"""Optional attributes of a point: the shape of its value."""

FARTHEST = np.float32(1e15)
"""Limit of valid coordinates: the squares of larger distances overflow single precision."""
UNIT_TOLERANCE = 1e-2
"""Largest deviation of a normal's length from 1; half precision keeps it within 1e-3."""

_RANGES = {"normals": "of length 1", "sizes": "above 0 and finite", "confidence": "from 0 to 1"}
_MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Coloured points in world coordinates.

    Args:
        xyz: Positions, float32 [N, 3], scene units, world frame.
        rgb: Colours, uint8 [N, 3].
        source: Origin of each point, uint8 [N]; 0 = original. All originals when left out.
        normals: Unit normals of the surface, float32 [N, 3], world axes; NaN where unknown.
        sizes: Initial radius of a Gaussian there, float32 [N], scene units, above 0;
            NaN where unknown.
        confidence: Confidence that a surface is there, float32 [N], 0 to 1; NaN where unknown.
        original_idx: Rows that ``select`` and ``concatenate`` keep, int32 [N], -1 for other points.
            None: an original's own row.

    Raises:
        PointCloudError: The shapes or the colour type do not fit, or an attribute is out of range.

    Example:
        >>> import numpy as np
        >>> cloud = PointCloud(np.zeros((2, 3)), np.full((2, 3), 128, np.uint8))
        >>> len(cloud), int(cloud.source.sum())
        (2, 0)
    """

    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    source: UInt8[np.ndarray, " N"] = None  # type: ignore[assignment]  # filled in __post_init__
    normals: Float32[np.ndarray, "N 3"] | None = None
    sizes: Float32[np.ndarray, " N"] | None = None
    confidence: Float32[np.ndarray, " N"] | None = None
    original_idx: Int32[np.ndarray, " N"] | None = None

    def __post_init__(self) -> None:
        xyz = np.asarray(self.xyz)
        rgb = np.asarray(self.rgb)
        source = (
            np.full(xyz.shape[:1], ORIGINAL, np.uint8)
            if self.source is None
            else np.asarray(self.source)
        )
        _check_shapes(xyz, rgb, source)
        for name, array, dtype in (
            ("xyz", xyz, np.float32),
            ("rgb", rgb, np.uint8),
            ("source", source, np.uint8),
        ):
            object.__setattr__(self, name, read_only(array, dtype))
        for name, value in self.attributes.items():
            values = np.asarray(value)
            _check_attribute(name, values, len(xyz))
            object.__setattr__(self, name, read_only(values, np.float32))
        if self.original_idx is not None:
            object.__setattr__(self, "original_idx", read_only(self.original_idx, np.int32))

    def __len__(self) -> int:
        return len(self.xyz)

    def __repr__(self) -> str:
        known = "".join(f", {name}" for name in self.attributes)
        return f"PointCloud({len(self):,} points, {self.num_original:,} of them original{known})"

    def __eq__(self, other: object) -> bool:
        """Whether two clouds have the same points and attributes in the same order."""
        if not isinstance(other, PointCloud):
            return NotImplemented
        own, others = self._arrays, other._arrays
        return own.keys() == others.keys() and all(
            values is others[name] or np.array_equal(values, others[name], equal_nan=True)
            for name, values in own.items()
        )

    def __hash__(self) -> int:
        return hash((PointCloud, len(self)))

    @staticmethod
    def empty() -> PointCloud:
        """Return a cloud without points."""
        return PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))

    @property
    def attributes(self) -> dict[str, Float32[np.ndarray, "N ..."]]:
        """The ``ATTRIBUTES`` that the cloud has, by name."""
        values = {name: getattr(self, name) for name in ATTRIBUTES}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def _arrays(self) -> dict[str, np.ndarray]:
        return {"xyz": self.xyz, "rgb": self.rgb, "source": self.source, **self.attributes}

    @property
    def num_original(self) -> int:
        """Number of points from the input."""
        return int(np.count_nonzero(self.source == ORIGINAL))

    @property
    def originals(self) -> PointCloud:
        """The original points only, in order."""
        return self.select(self.source == ORIGINAL)

    @property
    def references(self) -> PointCloud:
        """The points that locate the scene: the originals, or all if there are none."""
        return self.originals if self.num_original else self

    @property
    def finite(self) -> Bool[np.ndarray, " N"]:
        """Mask of points with three finite coordinates below ``FARTHEST``."""
        x, y, z = (np.abs(self.xyz[:, axis]) < FARTHEST for axis in range(3))  # NaN compares false
        return np.asarray(x & y & z)

    @property
    def distinct(self) -> Bool[np.ndarray, " N"]:
        """Mask of finite points that are the first at their position (-0.0 equals 0.0)."""
        distinct = self.finite
        distinct[distinct] = first_of_equals(self.xyz[distinct])
        return distinct

    @property
    def rows_of_originals(self) -> Int32[np.ndarray, " N"]:
        """``original_idx``, also where it is None."""
        if self.original_idx is not None:
            return self.original_idx
        rows = np.arange(len(self), dtype=np.int32)
        return np.where(self.source == ORIGINAL, rows, np.int32(-1))

    def select(self, which: Bool[np.ndarray, " N"] | Int[np.ndarray, " M"] | slice) -> PointCloud:
        """Return the points at ``which`` (a mask, indices or a slice), in that order."""
        chosen = {name: _unwritable(values[which]) for name, values in self._arrays.items()}
        return PointCloud(**chosen, original_idx=_unwritable(self.rows_of_originals[which]))

    def replace(self, **changes: np.ndarray | None) -> PointCloud:
        """Return a copy with some arrays replaced; None removes an attribute."""
        return dataclass_replace(self, **changes)  # type: ignore[arg-type]  # None for attributes

    def with_source(self, code: int) -> PointCloud:
        """Return a copy whose points are all from the method with this ``source`` code."""
        return self.replace(source=np.full(len(self), code, np.uint8), original_idx=None)

    def with_added(
        self,
        xyz: Float[np.ndarray, "M 3"],
        rgb: UInt8[np.ndarray, "M 3"],
        **attributes: Float[np.ndarray, "M ..."],
    ) -> PointCloud:
        """Return a copy with points of your own appended; their ``source`` is ``GENERATED``.

        Args:
            xyz: Positions, [M, 3], scene units, world frame.
            rgb: Colours, uint8 [M, 3].
            attributes: Any of ``normals``, ``sizes`` and ``confidence``; unknown where left out.

        Raises:
            PointCloudError: As for a new ``PointCloud``.
        """
        own = PointCloud(xyz, rgb, **attributes)
        return PointCloud.concatenate(self, own.with_source(GENERATED))

    @staticmethod
    def read_ply(path: str | Path) -> PointCloud:
        """Read the vertices of a PLY file as originals; mid grey without colours.

        Raises:
            SceneNotFoundError: There is no such file.
            SceneFormatError: It is no PLY, cut short, or has no vertices with x, y and z.
        """
        from splatseed.io.ply import read_ply

        return read_ply(path)

    def write_ply(self, path: str | Path) -> None:
        """Write positions (float32) and colours (uint8) as a binary PLY; replaces a file there.

        Every trainer of 3D Gaussian Splatting reads it. ``source`` and attributes are not in it.

        Raises:
            OutputError: It cannot be written.
        """
        from splatseed.io.ply import write_ply_file

        write_ply_file(path, self)

    @staticmethod
    def concatenate(*clouds: PointCloud) -> PointCloud:
        """Join clouds; attributes that one lacks and another has become NaN.

        Originals keep their ``original_idx``; of clouds after the first that have none, it is -1.
        """
        known = [name for name in ATTRIBUTES if any(name in c.attributes for c in clouds)]
        return PointCloud(
            _unwritable(np.concatenate([c.xyz for c in clouds])),
            _unwritable(np.concatenate([c.rgb for c in clouds])),
            _unwritable(np.concatenate([c.source for c in clouds])),
            **{name: _unwritable(_joined(clouds, name)) for name in known},
            original_idx=_joined_rows(clouds),
        )


def _unwritable(array: np.ndarray) -> np.ndarray:
    """Make an array read-only that nobody else holds, so that a cloud need not copy it."""
    array.flags.writeable = False
    return array


def _joined(clouds: Sequence[PointCloud], name: str) -> Float32[np.ndarray, "N ..."]:
    """Join an attribute of several clouds."""
    shape = ATTRIBUTES[name]
    return np.concatenate(
        [c.attributes.get(name, np.full((len(c), *shape), np.nan, np.float32)) for c in clouds]
    )


def _joined_rows(clouds: Sequence[PointCloud]) -> Int32[np.ndarray, " N"] | None:
    """Join ``original_idx`` of several clouds; None if each original has its own row."""
    first, *others = clouds
    if first.original_idx is None and not any(cloud.num_original for cloud in others):
        return None
    later = (np.full(len(c), -1) if c.original_idx is None else c.original_idx for c in others)
    return _unwritable(np.concatenate([first.rows_of_originals, *later], dtype=np.int32))


def first_of_equals(xyz: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Mark the finite rows that equal no earlier row; -0.0 equals 0.0.

    Exact: a hash only narrows the search.
    """
    xyz = np.ascontiguousarray(xyz + xyz.dtype.type(0))  # adding turns -0.0 into 0.0
    suspects = np.flatnonzero(_hash_collides(xyz))
    rows = xyz[suspects].view(np.dtype((np.void, 3 * xyz.itemsize))).ravel()
    first = np.ones(len(xyz), bool)
    first[suspects] = False
    first[suspects[np.unique(rows, return_index=True)[1]]] = True
    return first


def _hash_collides(xyz: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Mark rows that share a 64-bit hash with another: ten times faster than sorting rows."""
    bits = xyz.view(f"u{xyz.itemsize}").astype(np.uint64)
    products = bits * _MULTIPLIERS  # modulo 2^64
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
            found=_kind(xyz),
            fix="Pass one row x, y, z per point.",
        )
    if rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise PointCloudError(
            f"rgb as uint8 of shape {list(xyz.shape)}",
            found=_kind(rgb),
            fix="Scale colours to 0..255 and convert them with .astype(np.uint8).",
        )
    if source.shape != xyz.shape[:1]:
        raise PointCloudError(
            f"source of shape [{len(xyz)}]",
            found=f"{list(source.shape)}",
            fix="Pass one code per point, or leave it out.",
        )


def _kind(array: np.ndarray) -> str:
    """Describe an array, or the object that NumPy could not convert, such as None."""
    if array.dtype == object and not array.ndim:
        return visible(repr(array.item()))[:80]
    return f"{array.dtype} {list(array.shape)}"


def _check_attribute(name: str, values: np.ndarray, num_points: int) -> None:
    """Check an attribute's shape and range; NaN is always in range."""
    shape = (num_points, *ATTRIBUTES[name])
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise PointCloudError(
            f"{name} as numbers of shape {list(shape)}",
            found=f"{values.dtype} {list(values.shape)}",
            fix="Pass one value per point, NaN where it is not known, or leave them out.",
        )
    fits = np.isnan(values) | _in_range(name, values)
    wrong = np.unique(np.nonzero(~fits)[0])
    if wrong.size:
        raise PointCloudError(
            f"{name} {_RANGES[name]}, or NaN where not known",
            found=f"{values[wrong[0]].tolist()} at point {wrong[0]} and {wrong.size - 1:,} more",
            fix="Pass NaN for points where they are unknown.",
        )


def _in_range(name: str, values: Float[np.ndarray, "N ..."]) -> Bool[np.ndarray, "N ..."]:
    if name == "normals":
        squares = np.einsum("ij,ij->i", values, values, dtype=np.float64)
        return np.asarray(np.abs(squares - 1.0) <= 2 * UNIT_TOLERANCE)[:, None]
    if name == "sizes":
        with np.errstate(over="ignore", under="ignore"):
            sizes = values.astype(np.float32)  # the type they are stored in
        return np.asarray((sizes > 0) & np.isfinite(sizes))
    return np.asarray((values >= 0) & (values <= 1))
