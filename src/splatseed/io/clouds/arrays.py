"""NPZ archives of NumPy arrays: point maps of DUSt3R, MASt3R, VGGT and their kin, and plain clouds.

Positions are the first of ``POSITIONS`` that is there, of shape [..., 3]; colours the first of
``COLORS`` with as many values, which may hold channels before rows and columns, as networks have
images; ``MASKS`` say which points count, and of ``CONFIDENCES`` those below ``LEAST`` are left out.
Promise: members are read in parts, whether compressed or not; pickled objects are refused.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from splatseed.errors import SceneFormatError
from splatseed.io.archives import ARCHIVE_FAILURES
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.colors import ColorRange
from splatseed.io.clouds.rows import COPY_AGAIN
from splatseed.literal import told
from splatseed.process.memory import check_memory

POSITIONS = ("world_points", "pts3d", "points3d", "points", "xyz", "point_map", "pointmap")
COLORS = ("rgb", "colors", "colours", "color", "images", "imgs", "image", "rgb_img")
MASKS = ("mask", "masks", "valid", "valid_mask")
CONFIDENCES = ("world_points_conf", "conf", "confs", "confidence")
LEAST = 1.5
"""Least confidence that counts: these networks give 1 where they know nothing, and 3 to 30 on
surfaces."""
_STRAIGHTEN = "Save the array row by row: numpy.ascontiguousarray."


@dataclass(frozen=True)
class _Member:
    """An array of the archive.

    Args:
        name: Its name, without ".npy".
        shape: Its shape.
        dtype: Its type.
        turned: Whether it is stored column by column (Fortran's order), and so read whole.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    turned: bool = False

    @property
    def rows(self) -> int:
        """How many triples or values it holds, if its last axis is one triple."""
        return int(np.prod(self.shape[:-1], dtype=np.int64))


class NpzCloud(CloudFile):
    """An .npz archive with an array of points.

    Raises:
        SceneFormatError: It is no archive, or has no array of points, or arrays do not fit.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        members = _members(path)
        points = next((members[name] for name in POSITIONS if name in members), None)
        if points is None or points.shape[-1:] != (3,) or points.dtype.kind not in "fiu":
            found = ", ".join(f"{m.name} {list(m.shape)}" for m in members.values())
            raise SceneFormatError(
                f"{path} to hold points: one of {', '.join(POSITIONS)}, of shape [..., 3]",
                found=found[:200] or "no arrays",
                fix="Save the points under one of these names.",
            )
        self._points, self.count = points, points.rows
        self._color, self._planar = _colors_of(members, self.count)
        self._mask = _of_size(members, MASKS, self.count)
        self._confidence = _of_size(members, CONFIDENCES, self.count)
        self.colors = "rgb" if self._color else "none"
        self._range = self._color_range()

    def _color_range(self) -> ColorRange:
        if self._color is None or self._color.dtype == np.uint8:
            return ColorRange()
        first = next(_parts(self.path, self._color, 1 << 20), np.empty(0))
        return ColorRange.of(first[:, None])

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        streams: list[Iterator[np.ndarray]] = [_parts(self.path, self._points, 3 * size)]
        if self._color is not None:
            streams.append(self._painted(size))
        kinds = (self._mask, self._confidence)
        streams += [_parts(self.path, kept, size) for kept in kinds if kept is not None]
        for parts in zip(*streams, strict=True):
            xyz, *rest = parts
            rgb = rest.pop(0) if self._color is not None else None
            chunk = CloudChunk(xyz.reshape(-1, 3).astype(np.float64), rgb)
            valid = np.ones(len(chunk), bool)
            for kept, values in zip((self._mask, self._confidence), self._pads(rest), strict=True):
                if kept is not None and values is not None:
                    valid &= values >= LEAST if kept is self._confidence else values != 0
            if len(chunk := chunk.select(valid) if not valid.all() else chunk):
                yield chunk

    def _pads(self, rest: list[np.ndarray]) -> tuple[np.ndarray | None, np.ndarray | None]:
        """The mask's and the confidence's part, None where there is no such member."""
        mask = rest.pop(0) if self._mask is not None else None
        return mask, rest.pop(0) if self._confidence is not None else None

    def _painted(self, size: int) -> Iterator[np.ndarray]:
        """Colours, ``size`` points at a time."""
        color = self._color
        assert color is not None  # noqa: S101  (the caller's)
        if not self._planar:
            for part in _parts(self.path, color, 3 * size):
                yield self._range.to_bytes(part.reshape(-1, 3))
            return
        height, width = color.shape[-2:]
        held = np.empty((0, 3), np.uint8)
        for image in _parts(self.path, color, 3 * height * width):
            pixels = self._range.to_bytes(image.reshape(3, -1).T)
            held = np.concatenate([held, pixels])
            while len(held) >= size:
                yield held[:size]
                held = held[size:]
        if len(held):
            yield held


def _members(path: Path) -> dict[str, _Member]:
    """The arrays of an archive by name."""
    members = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                if name.endswith(".npy"):
                    with archive.open(name) as file:
                        shape, fortran, dtype = _header(file)
                    if not dtype.hasobject:
                        key = name.removesuffix(".npy")
                        members[key] = _Member(key, shape, dtype, fortran and len(shape) > 1)
    except ARCHIVE_FAILURES as error:
        raise _damaged(path, error) from None
    return members


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    return read(file)


def _parts(path: Path, member: _Member, size: int) -> Iterator[np.ndarray]:
    """The values of an array in order, flat, ``size`` at a time."""
    left = int(np.prod(member.shape, dtype=np.int64))
    if member.turned:
        check_memory(2 * left * member.dtype.itemsize, 1, "bytes", fix=_STRAIGHTEN)
        for values in _parts(path, replace(member, turned=False), max(left, 1)):
            straight = values.reshape(member.shape, order="F").ravel()
            yield from (straight[start : start + size] for start in range(0, left, size))
        return
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{member.name}.npy") as file:
            _header(file)
            while left:
                count = min(size, left)
                data = file.read(count * member.dtype.itemsize)
                if len(data) < count * member.dtype.itemsize:
                    raise ValueError(f"{member.name} ends early")
                yield np.frombuffer(data, member.dtype, count)
                left -= count
    except ARCHIVE_FAILURES as error:
        raise _damaged(path, error) from None


def _colors_of(members: dict[str, _Member], count: int) -> tuple[_Member | None, bool]:
    """The array of colours, and whether its channels come before rows and columns."""
    for name in COLORS:
        member = members.get(name)
        if member is None or member.dtype.kind not in "fu":
            continue
        if member.shape[-1:] == (3,) and member.rows == count:
            return member, False
        size = int(np.prod(member.shape, dtype=np.int64))
        if len(member.shape) >= 3 and member.shape[-3] == 3 and size == 3 * count:
            return member, True
    return None, False


def _of_size(members: dict[str, _Member], names: tuple[str, ...], count: int) -> _Member | None:
    """The first array of these names that has one value per point."""
    there = (members[name] for name in names if name in members)
    return next((m for m in there if np.prod(m.shape, dtype=np.int64) == count), None)


def _damaged(path: Path, error: Exception) -> SceneFormatError:
    expected = f"{path} to be an archive of NumPy arrays"
    return SceneFormatError(expected, found=told(error), fix=COPY_AGAIN)
