"""LZF, which PCD's compressed bodies are written in: decompression.

A block is a row of runs. A byte c below 32 is followed by c + 1 bytes as they are; any other begins
a reference: its upper 3 bits plus 2 are the length (7: plus the next byte), its lower 5 bits and
the last byte the distance back, minus 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from splatseed.kernels.jit import inline


def decompress(packed: bytes, size: int) -> bytes | None:
    """The ``size`` bytes that a block holds; None if it does not hold exactly so many."""
    out = np.empty(size, np.uint8)
    decode: Any = _decompress
    return out.tobytes() if decode(np.frombuffer(packed, np.uint8), out) else None


@inline
def _decompress(packed, out):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202  (Numba infers)
    i, o, num, size = 0, 0, len(packed), len(out)
    while i < num:
        c = int(packed[i])
        i += 1
        if c < 32:
            length = c + 1
            if i + length > num or o + length > size:
                return False
            for k in range(length):
                out[o + k] = packed[i + k]
            i += length
        else:
            length = (c >> 5) + 2
            if length == 9 and i < num:
                length += int(packed[i])
                i += 1
            if i >= num:
                return False
            back = o - ((c & 31) << 8) - int(packed[i]) - 1
            i += 1
            if back < 0 or o + length > size:
                return False
            for k in range(length):  # may overlap what it writes
                out[o + k] = out[back + k]
        o += length
    return o == size
