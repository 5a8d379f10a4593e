"""Samples of long sequences, spread evenly over them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Int64

Values = TypeVar("Values", bound=Sequence[object] | np.ndarray)


def evenly_spaced(count: int, limit: int) -> Int64[np.ndarray, " M"]:
    """Indices of ``limit`` of ``count`` items, first and last included; all if there are fewer.

    Example:
        >>> evenly_spaced(10, 4).tolist(), evenly_spaced(3, 4).tolist()
        ([0, 3, 6, 9], [0, 1, 2])
    """
    return np.linspace(0, count - 1, min(limit, count)).round().astype(np.int64)


def strided(values: Values, limit: int) -> Values:
    """Every n-th value, the first included, with the smallest n that gives at most ``limit``.

    Example:
        >>> strided([0, 1, 2, 3, 4, 5, 6], 3)
        [0, 3, 6]
    """
    return values[:: -(-len(values) // limit) or 1]  # type: ignore[return-value]
