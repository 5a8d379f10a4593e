"""Hashing for kernels: SplitMix64's finaliser, and tables of keys with open addressing.

Notation: a table of keys has 2^n slots of uint64, of which a free one holds ``FREE``; a key is
never ``FREE``. Promise: a table that is at most half full finds a key in a few steps.
"""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import inline

FREE = np.uint64(0)
"""A free slot of a table of keys."""


@inline
def scramble(x):  # type: ignore[no-untyped-def]  # Numba infers uint64
    """Scramble a uint64, a bijection: the finaliser of SplitMix64 (Steele, Lea and Flood, 2014)."""
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@inline
def slot_of(key, table):  # type: ignore[no-untyped-def]  # Numba's types
    """The slot of a key, or the free one where it belongs: the first from key mod 2^n on."""
    last = np.uint64(len(table) - 1)
    slot = key & last
    while table[slot] != FREE and table[slot] != key:
        slot = (slot + np.uint64(1)) & last
    return slot
