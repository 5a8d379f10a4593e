"""E57, by pye57 (libE57Format): terrestrial scans, each with its own pose.

The points of all scans come one scan after another, in the common frame that the scans' poses lead
to. Cartesian and spherical coordinates are read; points marked invalid are left out. Promise: a
scan is read in parts, never whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.colors import SAMPLE_ROWS, SAMPLES, ColorRange, GreyRange
from splatseed.io.clouds.rows import COPY_AGAIN
from splatseed.requirements import require

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_RGB = ("colorRed", "colorGreen", "colorBlue")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")
_OPTIONAL = (*_RGB, "intensity", *_INVALID)


@dataclass(frozen=True, eq=False)
class _Scan:
    """One scan of a file.

    Args:
        count: Its points.
        fields: The fields that are read.
        rotation: World from scan, float64 [3, 3].
        translation: The scanner's place, float64 [3].
    """

    count: int
    fields: tuple[str, ...]
    rotation: Float64[np.ndarray, "3 3"]
    translation: Float64[np.ndarray, " 3"]

    def positions(self, data: Mapping[str, np.ndarray]) -> Float64[np.ndarray, "n 3"]:
        """Points in the file's common frame."""
        if _CARTESIAN[0] in data:
            xyz = np.stack([data[name] for name in _CARTESIAN], axis=1)
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
        with _Opened(path) as file:
            self._scans = tuple(_describe(path, header) for header in file.headers)
        self.count = sum(scan.count for scan in self._scans)
        if not self._scans:
            raise SceneFormatError(f"{path} to hold scans", found="none", fix=COPY_AGAIN)
        colored = all(set(_RGB) <= set(scan.fields) for scan in self._scans)
        bright = all("intensity" in scan.fields for scan in self._scans)
        self.colors = "rgb" if colored else "intensity" if bright else "none"
        self._color, self._grey = self._ranges()

    def _ranges(self) -> tuple[ColorRange, GreyRange]:
        """Ranges of colour and intensity, from the beginning of each scan."""
        if self.colors == "none":
            return ColorRange(), GreyRange()
        heads = [data for i in range(len(self._scans)) for data in self._head(i)]
        if self.colors == "rgb":
            sample = [np.stack([data[name] for name in _RGB], axis=1) for data in heads]
            return ColorRange.of(np.concatenate(sample)), GreyRange()
        return ColorRange(), GreyRange.of(np.concatenate([data["intensity"] for data in heads]))

    def _head(self, index: int) -> Iterator[dict[str, np.ndarray]]:
        with _Opened(self.path) as file:
            for data in _read(self.path, file, index, self._scans[index], SAMPLES * SAMPLE_ROWS):
                yield data
                return

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        with _Opened(self.path) as file:
            for index, scan in enumerate(self._scans):
                for data in _read(self.path, file, index, scan, size):
                    chunk = CloudChunk(scan.positions(data), self._paint(data))
                    if len(chunk):
                        yield chunk

    def _paint(self, data: Mapping[str, np.ndarray]) -> np.ndarray | None:
        if self.colors == "rgb":
            return self._color.to_bytes(np.stack([data[name] for name in _RGB], axis=1))
        return self._grey.to_bytes(data["intensity"]) if self.colors == "intensity" else None


class _Opened:
    """An open E57 file and the headers of its scans."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Self:
        from pye57 import ScanHeader, libe57  # noqa: PLC0415  (an optional package)

        # not pye57.E57, which removes files that it fails to open
        self.image = _guarded(self.path, lambda: libe57.ImageFile(str(self.path), "r"))
        try:
            scans = _guarded(self.path, lambda: self.image.root()["data3D"])
            self.headers = [ScanHeader(scans[i]) for i in range(len(scans))]
        except BaseException:
            self.image.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.image.close()


def _describe(path: Path, header: Any) -> _Scan:
    known = set(header.point_fields)
    place = next((each for each in (_CARTESIAN, _SPHERICAL) if set(each) <= known), None)
    if place is None:
        raise SceneFormatError(
            f"{path} to hold cartesian or spherical coordinates",
            found=", ".join(sorted(known))[:160],
            fix=COPY_AGAIN,
        )
    fields = (*place, *(name for name in _OPTIONAL if name in known))
    if not header.has_pose():
        return _Scan(int(header.point_count), fields, np.eye(3), np.zeros(3))
    return _Scan(
        int(header.point_count),
        fields,
        np.asarray(header.rotation_matrix, np.float64),
        np.asarray(header.translation, np.float64),
    )


def _read(
    path: Path, file: _Opened, index: int, scan: _Scan, size: int
) -> Iterator[dict[str, np.ndarray]]:
    """The fields of the valid points of a scan, at most ``size`` at a time."""
    from pye57 import libe57  # noqa: PLC0415  (an optional package)

    room = min(size, max(scan.count, 1))
    arrays: dict[str, np.ndarray] = {name: np.empty(room, _dtype(name)) for name in scan.fields}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(file.image, name, array, room, True, True))
    reader = _guarded(path, lambda: file.headers[index].points.reader(buffers))
    given = 0
    while count := _guarded(path, reader.read):
        given += count
        valid = np.ones(count, bool)
        for name in _INVALID:
            if name in arrays:
                valid &= arrays[name][:count] == 0
        yield {name: array[:count][valid] for name, array in arrays.items()}
    reader.close()
    if given < scan.count:
        raise _damaged(path, f"{given:,} of {scan.count:,} points of scan {index}")


def _dtype(name: str) -> type:
    if name in _RGB:
        return np.float64  # bytes, 16-bit or 0 to 1: the values tell
    return np.int8 if name in _INVALID else np.float64


def _guarded(path: Path, read: Callable[[], Any]) -> Any:
    """What ``read`` gives; whatever the package raises on a bad file as our error."""
    try:
        return read()
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  (libE57Format raises errors of many kinds)
        raise _damaged(path, " ".join(str(error).split())[:160]) from None


def _damaged(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(f"{path} to be a complete E57 file", found=found, fix=COPY_AGAIN)
