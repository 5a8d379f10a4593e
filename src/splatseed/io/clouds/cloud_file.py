"""What every reader of clouds offers: a header, and the points in chunks.

Notation: a *row* is one point of a file. Promise: a file is never held in memory whole where its
format permits reading in parts; ``chunks`` may be called any number of times and gives the same
rows in the same order and of the same values whatever the size of the chunks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, UInt8

CHUNK = 1 << 20
"""Rows read at once unless the caller says otherwise: 50 to 100 MB while they are read."""

Colors: TypeAlias = Literal["rgb", "intensity", "none"]
"""Where the colours of a file's chunks come from."""


@dataclass(frozen=True, eq=False)
class CloudChunk:
    """Consecutive rows of a file.

    Args:
        xyz: Positions in the file's coordinates, float64 [n, 3]; may hold NaN or infinity.
        rgb: Colours, uint8 [n, 3], grey where the file has intensity only; None without either.
    """

    xyz: Float64[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def finite(self) -> Bool[np.ndarray, " n"]:
        """Which rows have three finite coordinates."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    def select(self, which: np.ndarray | slice) -> CloudChunk:
        """The rows at ``which`` (a mask, indices or a slice)."""
        return CloudChunk(self.xyz[which], None if self.rgb is None else self.rgb[which])


class CloudFile(ABC):
    """A file of points, opened but not read.

    Attributes:
        path: The file.
        count: Rows that its header promises; None where only reading tells. ``chunks`` may give
            fewer, as rows that the file itself marks as invalid are left out.
        bounds: Least and greatest coordinates, float64 [2, 3], where the header states them; they
            are what the file claims, and are not checked.
        colors: Where the colours come from.
        warnings: What is odd about the file, one sentence each.
    """

    path: Path
    count: int | None = None
    bounds: Float64[np.ndarray, "2 3"] | None = None
    colors: Colors = "none"
    warnings: tuple[str, ...] = ()

    @property
    def has_color(self) -> bool:
        """Whether its points have colours, rather than intensity or nothing."""
        return self.colors == "rgb"

    @abstractmethod
    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """The rows in file order, at most ``size`` at a time; no chunk is empty.

        Raises:
            SceneFormatError: The file ends early, or a row makes no sense.
        """
