"""DenseReport: statistics of the written maps, counted as they pass.

Promise: counting looks at each map once and keeps none of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatseed.io.dense.maps import DenseMap


@dataclass(frozen=True)
class DenseReport:
    """What was written.

    Args:
        path: The output folder.
        num_maps: How many maps.
        num_pixels: Pixels of all maps.
        num_known: Pixels with a depth.
        empty: Names of images whose map has no depth at all.
    """

    path: Path
    num_maps: int
    num_pixels: int
    num_known: int
    empty: tuple[str, ...]

    @property
    def share_known(self) -> float:
        """The share of pixels with a depth, 0 to 1."""
        return self.num_known / max(self.num_pixels, 1)


class DenseCount:
    """Counts maps."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._pixels, self._known = 0, 0
        self._empty: list[str] = []

    def add(self, dense: DenseMap) -> None:
        """Count one map."""
        known = int(np.count_nonzero(np.isfinite(dense.depth)))
        self.names.append(dense.name)
        self._pixels += dense.depth.size
        self._known += known
        self._empty += [] if known else [dense.name]

    def report(self, path: Path) -> DenseReport:
        """The counts so far."""
        counts = (len(self.names), self._pixels, self._known)
        return DenseReport(path, *counts, tuple(sorted(self._empty)))
