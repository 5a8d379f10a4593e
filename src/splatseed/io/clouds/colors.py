"""Colours and intensities of clouds as bytes, their range told from a sample of the file.

Notation: *full* is the value that means 255: 1, 255 or 65535. Formats with 16-bit colours are
filled with 8-bit values by many writers, so the values decide, not the type. Promise: the range
is fixed before the first chunk, so that chunks of any size give the same bytes; values beyond it
are clipped, and what is not a number becomes mid grey.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped, UInt8

SAMPLES, SAMPLE_ROWS = 16, 4096
"""Places in a file that are looked at to find ranges, and rows at each."""
GREY = 128
DARK, BRIGHT = 1.0, 99.0
"""Percentiles of intensity that become black and white: single mirrors outshine a whole scan."""


@dataclass(frozen=True)
class ColorRange:
    """From colours of any numeric type to bytes.

    Args:
        full: The value that means 255.
    """

    full: float = 255.0

    @classmethod
    def of(cls, sample: Shaped[np.ndarray, "N 3"]) -> ColorRange:
        """The range that a sample suggests."""
        if sample.dtype == np.uint8 or not sample.size:
            return cls()
        greatest = float(np.nanmax(np.asarray(sample, np.float64), initial=0.0))
        if greatest > 255.0:
            return cls(65535.0)
        return cls(1.0 if sample.dtype.kind == "f" and greatest <= 1.0 else 255.0)

    def to_bytes(self, values: Shaped[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
        """Colours as bytes, rounded."""
        if values.dtype == np.uint8:
            return np.ascontiguousarray(values)
        return _bytes_of(np.asarray(values, np.float32) * np.float32(255.0 / self.full))


@dataclass(frozen=True)
class GreyRange:
    """From intensities to grey.

    Args:
        low: What becomes black.
        high: What becomes white.
    """

    low: float = 0.0
    high: float = 1.0

    @classmethod
    def of(cls, sample: Shaped[np.ndarray, " N"]) -> GreyRange:
        """The range that a sample suggests."""
        values = np.asarray(sample, np.float64)
        values = values[np.isfinite(values)]
        if not values.size:
            return cls()
        low, high = np.percentile(values, (DARK, BRIGHT))
        return cls(float(low), float(high) if high > low else float(low) + 1.0)

    def to_bytes(self, values: Shaped[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
        """Intensities as grey, rounded."""
        share = (np.asarray(values, np.float64) - self.low) / (self.high - self.low)
        return np.repeat(_bytes_of(255.0 * share)[:, None], 3, axis=1)


def _bytes_of(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    known = np.nan_to_num(values, nan=GREY)
    return np.asarray(np.clip(np.rint(known), 0, 255).astype(np.uint8))


def sample_starts(count: int) -> list[int]:
    """First rows of the places that are looked at, spread over a file of ``count`` rows."""
    last = max(count - SAMPLE_ROWS, 0)
    return sorted({last * i // (SAMPLES - 1) for i in range(SAMPLES)}) if count else []
