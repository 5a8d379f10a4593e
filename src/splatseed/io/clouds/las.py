"""LAS and LAZ, by laspy with lazrs: survey scans.

Coordinates are float64 as the file's scale and offset have them. Colours are 16-bit by the standard
and 8-bit by habit: the values decide. Without colours, intensity. Points that the file marks as
withheld are left out. Promise: a LAZ file that ends early is an error, not a shorter cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.colors import SAMPLE_ROWS, ColorRange, GreyRange, sample_starts
from splatseed.io.clouds.rows import COPY_AGAIN
from splatseed.requirements import require

__all__ = ["LasCloud"]

_RGB = ("red", "green", "blue")


class LasCloud(CloudFile):
    """A LAS or LAZ file.

    Raises:
        MissingDependencyError: laspy or lazrs is not installed.
        SceneFormatError: It is not LAS, or cut short.
    """

    def __init__(self, path: Path) -> None:
        require("laspy", "lazrs")
        self.path = path
        with _Opened(path) as file:
            header = file.header
            self.count = int(header.point_count)
            self.bounds = np.array([header.mins, header.maxs], np.float64)
            names = set(header.point_format.dimension_names)
            sample = _sample(file, path, self.count)
        self._names = names
        self._color = ColorRange()
        self._grey: GreyRange | None = None
        if names >= set(_RGB) and (sample.size == 0 or sample[:, :3].any()):
            self.colors = "rgb"
            self._color = ColorRange.of(sample[:, :3])
        elif sample.size and np.ptp(sample[:, 3]) > 0:
            self.colors = "intensity"
            self._grey = GreyRange.of(sample[:, 3])

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        given = 0
        with _Opened(self.path) as file:
            while given < (self.count or 0):
                points = _guarded(self.path, lambda: file.read_points(size))
                if not len(points):
                    raise _cut_short(self.path, f"{given:,} of {self.count:,} points")
                given += len(points)
                if len(chunk := self._chunk(points)):
                    yield chunk

    def _chunk(self, points: Any) -> CloudChunk:
        xyz = np.stack([np.asarray(points[name], np.float64) for name in "xyz"], axis=1)
        rgb = None
        if self.colors == "rgb":
            rgb = self._color.to_bytes(np.stack([np.asarray(points[n]) for n in _RGB], axis=1))
        elif self._grey is not None:
            rgb = self._grey.to_bytes(np.asarray(points["intensity"]))
        chunk = CloudChunk(xyz, rgb)
        if "withheld" not in self._names:
            return chunk
        withheld = np.asarray(points["withheld"], bool)
        return chunk.select(~withheld) if withheld.any() else chunk


class _Opened:
    """A laspy reader whose failures are ours."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Any:
        import laspy  # noqa: PLC0415  (an optional package)

        self.reader = _guarded(self.path, lambda: laspy.open(self.path))
        return self.reader

    def __exit__(self, *_: object) -> None:
        self.reader.close()


def _sample(file: Any, path: Path, count: int) -> np.ndarray:
    """Red, green, blue and intensity of points spread over the file, [n, 4]; 0 where absent."""
    parts = []
    names = set(file.header.point_format.dimension_names)
    for start in sample_starts(count):
        _guarded(path, lambda at=start: file.seek(at))  # type: ignore[misc]  # bound at once
        points = _guarded(path, lambda: file.read_points(SAMPLE_ROWS))
        table = np.zeros((len(points), 4), np.uint16)
        for i, name in enumerate((*_RGB, "intensity")):
            if name in names:
                table[:, i] = points[name]
        parts.append(table)
    return np.concatenate(parts) if parts else np.empty((0, 4), np.uint16)


def _guarded(path: Path, read: Callable[[], Any]) -> Any:
    """What ``read`` gives; whatever the package raises on a bad file as our error."""
    try:
        return read()
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  (laspy and lazrs raise errors of many kinds)
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise _cut_short(path, f"one that is cut short or damaged ({reason})") from None


def _cut_short(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(f"{path} to be a complete LAS or LAZ file", found=found, fix=COPY_AGAIN)
