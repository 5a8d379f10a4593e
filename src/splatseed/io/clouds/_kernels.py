"""Decompression of LZF, the compression of binary PCD files."""

import numpy as np

from splatseed.runtime.jit import inline


@inline
def decompress_lzf(packed: np.ndarray, out: np.ndarray) -> bool:  # uint8 [B], [S]
    """Decompress an LZF block into ``out``; return whether it holds exactly ``len(out)`` bytes.

    A control byte c below 32 precedes c + 1 literal bytes. Any other c starts a back reference: its
    upper 3 bits plus 2 are the length (for 7, the next byte is added), and its lower 5 bits with
    the byte that follows are the distance minus 1.
    """
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
            for k in range(length):  # source and target may overlap
                out[o + k] = out[back + k]
        o += length
    return o == size
