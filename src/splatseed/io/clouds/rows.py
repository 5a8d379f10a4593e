"""Clouds whose points are binary rows of one length: PLY and PCD.

Notation: a row is a NumPy record. Promise: rows are read by offset, so that only those asked for
are in memory; a file that is shorter than its header promises is refused when it is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Shaped, UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CloudChunk, Colors
from splatseed.io.clouds.colors import SAMPLE_ROWS, ColorRange, GreyRange, sample_starts
from splatseed.io.files import open_file

COPY_AGAIN = "Copy the file again, or export it again."

XYZ = ("x", "y", "z")
RGB_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
SH_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
INTENSITY_NAMES = (
    "intensity",
    "scalar_intensity",
    "scalar_Intensity",
    "Intensity",
    "reflectance",
    "scalar_Reflectance",
)
SH0 = 0.28209479177387814  # 1 / (2 sqrt(pi)); colour = 0.5 + SH0 * f_dc in 3DGS


@dataclass(frozen=True)
class Columns:
    """Which columns of a table are used.

    Args:
        rgb: Names of the three colour columns; empty for none.
        intensity: Name of the intensity column; None for none, or where there are colours.
    """

    rgb: tuple[str, ...] = ()
    intensity: str | None = None

    @classmethod
    def among(cls, names: Sequence[str]) -> Columns:
        """The columns that a table with these names has."""
        known = (*RGB_NAMES, SH_NAMES)
        rgb = next((each for each in known if set(each) <= set(names)), ())
        if rgb:
            return cls(rgb)
        return cls((), next((each for each in INTENSITY_NAMES if each in names), None))

    @property
    def colors(self) -> Colors:
        """Where colours come from."""
        return "rgb" if self.rgb else "intensity" if self.intensity else "none"


class Painter:
    """Turns columns into colours, with ranges found in a sample.

    Args:
        columns: Which columns to use.
        sample: By name, values of some rows.
    """

    def __init__(self, columns: Columns, sample: Callable[[str], np.ndarray]) -> None:
        self.columns = columns
        self.of_trained = columns.rgb == SH_NAMES
        if columns.rgb and not self.of_trained:
            colors = np.stack([sample(name) for name in columns.rgb], axis=1)
            self.color = ColorRange.of(colors)
        elif columns.intensity:
            self.grey = GreyRange.of(sample(columns.intensity))

    def paint(self, column: Callable[[str], np.ndarray]) -> UInt8[np.ndarray, "N 3"] | None:
        """The colours of rows whose columns are given by name; None without any."""
        if self.columns.rgb:
            values = np.stack([column(name) for name in self.columns.rgb], axis=1)
            return self._from_harmonics(values) if self.of_trained else self.color.to_bytes(values)
        if self.columns.intensity:
            return self.grey.to_bytes(column(self.columns.intensity))
        return None

    @staticmethod
    def _from_harmonics(values: Shaped[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
        return ColorRange(1.0).to_bytes(0.5 + SH0 * np.asarray(values, np.float64))


def positions(column: Callable[[str], Any]) -> Float64[np.ndarray, "N 3"]:
    """The positions of rows whose columns are given by name; damaged ones may not be finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.stack([np.asarray(column(name), np.float64) for name in XYZ], axis=1)


def check_size(path: Path, needed: int) -> None:
    """Check that a file has at least ``needed`` bytes.

    Raises:
        SceneFormatError: It is shorter.
    """
    size = path.stat().st_size
    if size < needed:
        raise SceneFormatError(
            f"{path} to have {needed:,} bytes, as its header promises",
            found=f"{size:,}: the file is cut short",
            fix=COPY_AGAIN,
        )


def read_rows(
    path: Path, dtype: np.dtype[Any], offset: int, count: int, size: int
) -> Iterator[np.ndarray]:
    """Rows from a byte offset on, at most ``size`` at a time."""
    with open_file(path) as file:
        file.seek(offset)
        for start in range(0, count, size):
            wanted = min(size, count - start)
            data = file.read(wanted * dtype.itemsize)
            if len(data) < wanted * dtype.itemsize:
                check_size(path, offset + count * dtype.itemsize)
            yield np.frombuffer(data, dtype, wanted)


def sample_rows(path: Path, dtype: np.dtype[Any], offset: int, count: int) -> np.ndarray:
    """Rows from places spread over the file."""
    parts = [
        np.concatenate(list(read_rows(path, dtype, offset + i * dtype.itemsize, size, size)))
        for i in sample_starts(count)
        if (size := min(SAMPLE_ROWS, count - i))
    ]
    return np.concatenate(parts) if parts else np.empty(0, dtype)


def chunk_of(painter: Painter, column: Callable[[str], np.ndarray]) -> CloudChunk:
    """A chunk of rows whose columns are given by name."""
    return CloudChunk(positions(column), painter.paint(column))
