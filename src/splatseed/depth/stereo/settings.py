"""The choices of stereo, with their defaults."""

from __future__ import annotations

from dataclasses import dataclass

from splatseed.errors import ParameterError

TOO_FEW = 30
"""Points that are not worth being searched around, and vouch for no pose."""
LEAST_SIZE = 32
MOST_GRID = 32
MOST_SOURCES = 8
"""Bits of the byte that records which views agree."""


@dataclass(frozen=True)
class StereoSettings:
    """The choices of stereo: depth from photographs alone."""

    max_size: int = 800
    """Photographs are downsampled by a whole factor to at most this many pixels a side."""
    grid: int = 4
    """Pixels between depths, along a row and a column."""
    sweeps: int = 4
    """PatchMatch iterations: each propagates and refines all planes."""
    num_sources: int = 5
    """Views in which a plane is compared."""
    num_witnesses: int = 8
    """Views that may confirm a depth."""
    min_agreeing: int = 2
    """How many of these views must confirm it."""
    tolerance: float = 0.01
    """Relative difference at which two depths agree."""
    max_cost: float = 0.5
    """Pixels of higher cost (one minus correlation, 0 to 2) are left out."""

    def __post_init__(self) -> None:
        _check(
            self.max_size >= LEAST_SIZE, f"stereo.max_size of at least {LEAST_SIZE}", self.max_size
        )
        _check(1 <= self.grid <= MOST_GRID, f"stereo.grid from 1 to {MOST_GRID}", self.grid)
        _check(self.sweeps >= 1, "stereo.sweeps of at least 1", self.sweeps)
        most = MOST_SOURCES
        _check(
            1 <= self.num_sources <= most, f"stereo.num_sources from 1 to {most}", self.num_sources
        )
        _check(
            1 <= self.num_witnesses <= most,
            f"stereo.num_witnesses from 1 to {most}",
            self.num_witnesses,
        )
        _check(
            1 <= self.min_agreeing <= self.num_witnesses,
            f"stereo.min_agreeing from 1 to {self.num_witnesses}",
            self.min_agreeing,
        )
        _check(0 < self.tolerance < 1, "stereo.tolerance between 0 and 1", self.tolerance)
        _check(0 < self.max_cost <= 2, "stereo.max_cost above 0, 2 at most", self.max_cost)


def _check(condition: bool, expected: str, found: object) -> None:
    if not condition:
        raise ParameterError(expected, found=repr(found), fix="Choose such a value.")
