"""E57, by pye57 (libE57Format): terrestrial scans, each with its own pose.

The points of all scans come one scan after another, in the common frame that the scans' poses lead
to. Cartesian and spherical coordinates are read; points marked invalid are left out. Promise: a
scan is read in parts, never whole.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.io.cloud_file import (
    CHUNK,
    SAMPLE_ROWS,
    SAMPLES,
    CloudChunk,
    CloudFile,
    Columns,
    Painter,
    positions,
)
from splatseed.io.files import guarded
from splatseed.requirements import require

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_RGB = ("colorRed", "colorGreen", "colorBlue")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


@dataclass(frozen=True, eq=False)
class _Scan:
    """One scan of a file: its points, the fields that are read, and world from scan."""

    count: int
    fields: tuple[str, ...]
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    @classmethod
    def of(cls, header: Any) -> _Scan:
        """The scan that pye57's header describes."""
        known = set(header.point_fields)
        place = next((each for each in (_CARTESIAN, _SPHERICAL) if set(each) <= known), None)
        if place is None:
            raise ValueError(f"neither cartesian nor spherical coordinates: {sorted(known)}")
        optional = (*_RGB, "intensity", *_INVALID)
        fields = (*place, *(name for name in optional if name in known))
        if not header.has_pose():
            return cls(int(header.point_count), fields, np.eye(3), np.zeros(3))
        rotation = np.asarray(header.rotation_matrix, np.float64)
        translation = np.asarray(header.translation, np.float64)
        return cls(int(header.point_count), fields, rotation, translation)

    def positions(self, data: Mapping[str, np.ndarray]) -> Float64[np.ndarray, "n 3"]:
        """Points in the file's common frame."""
        if _CARTESIAN[0] in data:
            xyz = positions(data.__getitem__, _CARTESIAN)
        else:
            distance, azimuth, elevation = (data[name] for name in _SPHERICAL)
            flat = distance * np.cos(elevation)
            height = distance * np.sin(elevation)
            xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], axis=1)
        return np.asarray(xyz @ self.rotation.T + self.translation)


class E57Cloud(CloudFile):
    """An E57 file.

    Raises:
        MissingDependencyError: pye57 is not installed.
        SceneFormatError: It is not E57, damaged, or holds no points.
    """

    def __init__(self, path: Path) -> None:
        require("pye57")
        self.path = path
        with _opened(path) as (image, headers):
            self._scans = tuple(map(_Scan.of, headers))
            self.count = sum(scan.count for scan in self._scans)
            if not self._scans:
                raise ValueError("no scans")
            columns = Columns()
            if all(set(_RGB) <= set(scan.fields) for scan in self._scans):
                columns = Columns(_RGB)
            elif all("intensity" in scan.fields for scan in self._scans):
                columns = Columns((), "intensity")
            self.colors = columns.colors
            most = SAMPLES * SAMPLE_ROWS
            heads = [
                next(_read(image, header, scan, most), {name: np.empty(0) for name in scan.fields})
                for header, scan in zip(headers, self._scans, strict=True)
            ]
        # Ranges are those of the beginning of each scan.
        known = {
            name: np.concatenate([each[name] for each in heads if name in each])
            for name in (*_RGB, "intensity")
            if any(name in each for each in heads)
        }
        self._painter = Painter(columns, lambda: known.__getitem__)

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        with _opened(self.path) as (image, headers):
            for header, scan in zip(headers, self._scans, strict=True):
                for data in _read(image, header, scan, size):
                    rgb = self._painter.paint(data.__getitem__)
                    if len(chunk := CloudChunk(scan.positions(data), rgb)):
                        yield chunk


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, list[Any]]]:
    """An open file and the headers of its scans; failures become one of our errors."""
    from pye57 import ScanHeader, libe57  # noqa: PLC0415  (an optional package)

    with guarded(path, "a complete E57 file"):
        image = libe57.ImageFile(str(path), "r")  # pye57.E57 removes files that it fails to open
        try:
            scans = image.root()["data3D"]
            yield image, [ScanHeader(scans[i]) for i in range(len(scans))]
        finally:
            image.close()


def _read(image: Any, header: Any, scan: _Scan, size: int) -> Iterator[dict[str, np.ndarray]]:
    """The fields of the valid points of a scan, at most ``size`` at a time."""
    from pye57 import libe57  # noqa: PLC0415  (an optional package)

    room = min(size, max(scan.count, 1))
    arrays: dict[str, np.ndarray] = {
        # Colours may be bytes, 16-bit or 0 to 1: the values tell.
        name: np.empty(room, np.int8 if name in _INVALID else np.float64)
        for name in scan.fields
    }
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, room, True, True))
    reader = header.points.reader(buffers)
    given = 0
    while count := reader.read():
        given += count
        valid = np.ones(count, bool)
        for name in _INVALID:
            if name in arrays:
                valid &= arrays[name][:count] == 0
        yield {name: array[:count][valid] for name, array in arrays.items()}
    reader.close()
    if given < scan.count:
        raise ValueError(f"{given:,} of {scan.count:,} points of a scan")
