"""Hash in kernels: SplitMix64's finaliser, and hash tables with open addressing.

A table has 2^n slots of uint64; a free slot holds ``FREE``, which no key may equal. In a table at
most half full, a look-up takes a few steps.
"""

from __future__ import annotations

import numpy as np

from splatseed.runtime.jit import inline

FREE = np.uint64(0)
"""The value of a free slot."""


@inline
def scramble(x):
    """Scramble a uint64, a bijection: the finaliser of SplitMix64 (Steele, Lea and Flood, 2014)."""
    x += np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@inline
def slot_of(key, table):
    """Return the slot of a key, or the free slot for it: the first from key mod 2^n on."""
    last = np.uint64(len(table) - 1)
    slot = key & last
    while table[slot] != FREE and table[slot] != key:
        slot = (slot + np.uint64(1)) & last
    return slot
