"""Laser scans: LAS and LAZ by laspy with lazrs, E57 by pye57 (libE57Format).

LAS: withheld points are skipped; if all colours are 0, varying intensity is used instead. E57: the
points of all scans, moved to the common frame by the scans' poses; invalid points are skipped, and
invalid colours black. A rotation of 0 is none; white is a scan's colour limit, if its values fit.
Promise: a truncated LAZ file is an error, not a shorter cloud. Its chunk table is checked before
lazrs, which aborts the process on huge allocations, reads it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import rotation_from_quat
from splatseed.findings import Finding
from splatseed.io import cloud_file
from splatseed.io.cloud_file import RGB, XYZ, Block, CloudFile, to_uint8, white_level
from splatseed.io.files import translate_errors
from splatseed.requirements import require

_WHERE_POINTS, _RECORD = 96, 54
"""Offset in the header of the points' offset and the number of variable length records; smallest
size of such a record, bytes."""
_MAX_BYTES = 1 << 30
"""Largest decompressed chunk; writers use 50,000 points of 20 to about 100 bytes."""
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_AXES = (("cartesianX", "cartesianY", "cartesianZ"), _SPHERICAL)
_E57_COLORS = {"colorRed": "red", "colorGreen": "green", "colorBlue": "blue"}
_INVALID, _NO_COLOR = ("cartesianInvalidState", "sphericalInvalidState"), "isColorInvalid"
_BYTE = 255.0


class LasCloud(CloudFile):
    """A LAS or LAZ file."""

    def __init__(self, path: Path) -> None:
        require("laspy", "lazrs")
        with _opened_las(path) as file:
            self._num_rows = int(file.header.point_count)
            names = set(file.header.point_format.dimension_names)
            there = [name for name in (*RGB, "intensity") if name in names]
            parts = {name: [np.empty(0, np.uint16)] for name in there}
            for start in cloud_file.sample_starts(self._num_rows):
                file.seek(start)
                points = file.read_points(cloud_file.SAMPLE_ROWS)
                for name in there:
                    parts[name].append(np.asarray(points[name], np.uint16))
        self._known = {name: np.concatenate(each) for name, each in parts.items()}
        self._marks_withheld = "withheld" in names
        if self._num_rows and not any(self._known[name].any() for name in set(RGB) & names):
            names -= set(RGB)
        intensity = self._known.get("intensity", np.empty(0))
        if not len(intensity) or not np.ptp(intensity):
            names.discard("intensity")
        super().__init__(path, names, self._num_rows)

    def _sample(self) -> Block:
        return self._known

    def _blocks(self, size: int) -> Iterator[Block]:
        given = 0
        with _opened_las(self.path) as file:
            while given < self._num_rows:
                points = file.read_points(size)
                if not len(points):
                    raise ValueError(f"{given:,} of {self._num_rows:,} points")
                given += len(points)
                kept = np.ones(len(points), bool)
                if self._marks_withheld:
                    kept = ~np.asarray(points["withheld"], bool)
                yield {name: np.asarray(points[name])[kept] for name in self.used}


@contextmanager
def _opened_las(path: Path) -> Iterator[Any]:
    """Open a laspy reader; its exceptions become ``SceneFormatError``."""
    import laspy  # noqa: PLC0415  (an optional package)

    with translate_errors(path, "a complete LAS or LAZ file"):
        # laspy allocates the header's records before the points, whatever the file's size.
        # Source: LAS 1.4 R15, tables 3 and 7.
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(_WHERE_POINTS)
            start, number = struct.unpack("<II", file.read(8))
        if start > size or number * _RECORD > size:
            raise ValueError(f"{number:,} records and points from byte {start:,} in {size:,} bytes")
        with laspy.open(path, read_evlrs=False) as reader:
            header = reader.header
            if header.are_points_compressed:
                _check_chunks(path, header)
            else:
                bodies = header.point_count * header.point_format.size
                cloud_file.check_min_size(path, header.offset_to_point_data + bodies)
            yield reader


def _check_chunks(path: Path, header: Any) -> None:
    """Raise ``ValueError`` for a LAZ file with an impossible header or chunk table.

    Source: the LAZ specification (rapidlasso), "LASzip VLR" and "Chunk table".
    """
    import lazrs  # noqa: PLC0415  (an optional package)

    if not header.point_count:
        return  # the table is optional
    size, bytes_each = path.stat().st_size, header.point_format.size
    vlr = lazrs.LazVlr(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    if vlr.item_size() != bytes_each:
        raise ValueError(f"points of {vlr.item_size():,} bytes, not {bytes_each:,}")
    with path.open("rb") as file:
        number = _number_of_chunks(file, header.offset_to_point_data)
        # A chunk starts with an uncompressed point.
        if number * bytes_each > size:
            raise ValueError(f"{number:,} chunks in {size:,} bytes")
        file.seek(header.offset_to_point_data)
        chunks = np.array(lazrs.read_chunk_table(file, vlr), np.float64).reshape(number, 2)
    points, packed = chunks.sum(axis=0)
    largest = chunks[:, 0].max() * bytes_each
    if packed > size or points < header.point_count or largest > _MAX_BYTES:
        found = f"chunks of {points:,.0f} points in {packed:,.0f} bytes"
        raise ValueError(f"{found}, for {header.point_count:,} points in {size:,} bytes")


def _number_of_chunks(file: IO[bytes], start: int) -> int:
    """Read the number of chunks, which precedes their table."""
    file.seek(start)
    (offset,) = struct.unpack("<q", file.read(8))
    if offset <= start:  # a streaming writer puts the offset at the end
        file.seek(-8, os.SEEK_END)
        (offset,) = struct.unpack("<q", file.read(8))
    file.seek(offset)
    _, number = struct.unpack("<II", file.read(8))
    return int(number)


class E57Cloud(CloudFile):
    """An E57 file."""

    def __init__(self, path: Path) -> None:
        require("pye57")
        findings = []
        with _opened_e57(path) as (_, headers):
            if not headers:
                raise ValueError("no scans")
            shared = set.intersection(*(set(header.point_fields) for header in headers))
            count = sum(int(header.point_count) for header in headers)
            self._poses = [_pose(header, f"scan {i + 1}") for i, header in enumerate(headers)]
        zero = [str(i + 1) for i, (quat, _) in enumerate(self._poses) if not quat.any()]
        if zero:
            text = f"The rotation of scan {', '.join(zero)} is (0, 0, 0, 0): none is applied."
            findings.append(Finding("zero-rotation", text))
        super().__init__(path, (_E57_COLORS.get(name, name) for name in (*XYZ, *shared)), count)
        self.findings = tuple(findings)

    @cached_property
    def _heads(self) -> tuple[list[float], Block]:
        """White of each scan, and the start of all scans."""
        size, whites, heads = cloud_file.SAMPLES * cloud_file.SAMPLE_ROWS, list[float](), []
        with _opened_e57(self.path) as (image, headers):
            for header, pose in zip(headers, self._poses, strict=True):
                head = next(_read_scan(image, header, pose, size), {})
                known = [head[name] for name in RGB if name in head and self._rgb]
                whites.append(_white(header, np.stack(known, axis=1)) if known else 255.0)
                heads.append(_with_bytes(head, whites[-1]))
        none = np.empty(0)
        return whites, {
            n: np.concatenate([h[n] for h in heads if n in h] or [none]) for n in self.used
        }

    def _sample(self) -> Block:
        """Return the start of each scan."""
        return self._heads[1]

    def _blocks(self, size: int) -> Iterator[Block]:
        whites = self._heads[0]
        with _opened_e57(self.path) as (image, headers):
            for header, pose, white in zip(headers, self._poses, whites, strict=True):
                for block in _read_scan(image, header, pose, size):
                    yield _with_bytes(block, white)


def _with_bytes(block: Block, white: float) -> dict[str, np.ndarray]:
    """Return a block with its colours as bytes."""
    return {n: to_uint8(block[n], white) if n in RGB else block[n] for n in block}


def _white(header: Any, colors: Float64[np.ndarray, "N 3"]) -> float:
    """Return the white of a scan: its limit, or that of its values if they are beyond.

    Values of 8 bits under a limit of 16 are of writers that fill in the type's.
    """
    found = white_level(colors)
    with suppress(Exception):  # no limits, or not as the standard has them
        limits = header["colorLimits"]
        limit = max(_number(limits[f"{name}Maximum"]) for name in _E57_COLORS)
        if found <= limit and (found > _BYTE or limit == found):
            return limit
    return found


def _pose(header: Any, name: str) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """Return the quaternion (wxyz, of any length) and the translation of a scan.

    Either may be missing; children are in any order.
    """
    values = {"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
    node = header.node
    if node.isDefined("pose"):
        for key, axes in (("rotation", "wxyz"), ("translation", "xyz")):
            if node["pose"].isDefined(key):
                values[key] = [_number(node["pose"][key][axis]) for axis in axes]
    quat, shift = (np.array(each, np.float64) for each in values.values())
    if not (np.isfinite(quat).all() and np.isfinite(shift).all()):
        label = f"{name}, {node['name'].value()!r}" if node.isDefined("name") else name
        numbers = ", ".join(f"{x:g}" for x in (*quat, *shift))
        raise ValueError(f"a pose of {label} that is not finite: {numbers}")
    return quat / (np.abs(quat).max() or 1.0), shift


def _number(node: Any) -> float:
    return float(node.scaledValue() if hasattr(node, "scaledValue") else node.value())


@contextmanager
def _opened_e57(path: Path) -> Iterator[tuple[Any, list[Any]]]:
    """Open a file; yield it and its scans' headers; exceptions become ``SceneFormatError``."""
    from pye57 import ScanHeader, libe57  # noqa: PLC0415  (an optional package)

    with translate_errors(path, "a complete E57 file"):
        image = libe57.ImageFile(str(path), "r")  # pye57.E57 deletes files that it fails to open
        try:
            scans = image.root()["data3D"]
            yield image, [ScanHeader(scans[i]) for i in range(len(scans))]
        finally:
            image.close()


def _read_scan(
    image: Any, header: Any, pose: tuple[np.ndarray, np.ndarray], size: int
) -> Iterator[dict[str, np.ndarray]]:
    """Yield the valid points of a scan in the common frame, at most ``size`` at a time."""
    from pye57 import libe57  # noqa: PLC0415  (an optional package)

    axes = next((p for p in _AXES if set(p) <= set(header.point_fields)), None)
    if axes is None:
        raise ValueError(f"neither cartesian nor spherical coordinates: {header.point_fields}")
    count, optional = int(header.point_count), (*_E57_COLORS, "intensity", *_INVALID, _NO_COLOR)
    fields = (*axes, *(name for name in optional if name in header.point_fields))
    room = min(size, max(count, 1))
    # Colours may be 8-bit, 16-bit or 0 to 1.
    flags = (*_INVALID, _NO_COLOR)
    kinds = {name: np.int8 if name in flags else np.float64 for name in fields}
    arrays: dict[str, np.ndarray] = {name: np.empty(room, kind) for name, kind in kinds.items()}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, room, True, True))
    reader = header.points.reader(buffers)
    given = 0
    while number := reader.read():
        given += number
        valid = np.ones(number, bool)
        for name in _INVALID:
            if name in arrays:
                valid &= arrays[name][:number] == 0
        data = {name: array[:number][valid] for name, array in arrays.items()}
        xyz = _placed(np.stack([data[name] for name in axes], axis=1), axes == _SPHERICAL, pose)
        if _NO_COLOR in data:
            for name in _E57_COLORS.keys() & data.keys():
                data[name][data[_NO_COLOR] != 0] = 0.0
        named = {_E57_COLORS.get(name, name): values for name, values in data.items()}
        yield named | dict(zip(XYZ, xyz.T, strict=True))
    reader.close()
    if given < count:
        raise ValueError(f"{given:,} of {count:,} points of a scan")


def _placed(
    xyz: Float64[np.ndarray, "N 3"], is_spherical: bool, pose: tuple[np.ndarray, np.ndarray]
) -> Float64[np.ndarray, "N 3"]:
    """Return a scan's positions, possibly range, azimuth and elevation, in the file's frame."""
    if is_spherical:
        distance, azimuth, elevation = xyz.T
        flat, height = distance * np.cos(elevation), distance * np.sin(elevation)
        xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)
    quat, shift = pose
    if quat.any():
        xyz = xyz @ rotation_from_quat(quat).T
    return np.asarray(xyz + shift)
