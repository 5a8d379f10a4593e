"""A hash of 64-bit words, for kernels: SplitMix64's finaliser."""

from __future__ import annotations

import numpy as np

from splatseed.kernels.jit import inline

__all__ = ["scramble"]


@inline
def scramble(x):  # type: ignore[no-untyped-def]  # Numba infers uint64
    """Scramble a uint64, a bijection: the finaliser of SplitMix64 (Steele, Lea and Flood, 2014)."""
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
